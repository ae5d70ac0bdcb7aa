"""Points marked in several photos: exact, with a covariance that covers the error, without wrong marks."""

from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from sfm_app.frame.sighted_points import Sight, SightedPoint, layout_scale, locate_point, unrotate_pixels
from sfm_app.types import Photo

FOCAL = 1000.0


def looks(point, rng, photos=6, noise_px=0.5, wrong=()):
    """Sights of a point from cameras about it; those of the wrong ones are 40 pixels off."""
    found = []
    for k in range(photos):
        center = point + np.array([np.cos(k), 0.3 * np.sin(3 * k), np.sin(k)]) * rng.uniform(3, 5)
        ray = (point - center) / np.linalg.norm(point - center)
        off = rng.normal(size=3) * (noise_px / FOCAL)
        if k in wrong:
            off += np.cross(ray, [0.0, 1.0, 0.0]) * (40 / FOCAL)
        ray = ray + off - ray * (ray @ off)
        found.append(Sight(f"{k}.jpg", center, ray / np.linalg.norm(ray), FOCAL))
    return found


def test_rays_meet_in_the_point_within_its_covariance():
    rng, normalized = np.random.default_rng(0), []
    for _ in range(60):
        point = rng.normal(size=3)
        found = locate_point(looks(point, rng))
        assert isinstance(found, SightedPoint)
        assert found.outliers == ()
        off = found.place - point
        normalized.append(off @ np.linalg.inv(found.covariance) @ off / 3)
    assert 0.6 < np.mean(normalized) < 1.9


def test_wrong_marks_are_left_out_and_named():
    rng = np.random.default_rng(1)
    for _ in range(20):
        point = rng.normal(size=3)
        found = locate_point(looks(point, rng, wrong=(1, 4)))
        assert isinstance(found, SightedPoint)
        assert found.outliers == ("1.jpg", "4.jpg")
        assert np.linalg.norm(found.place - point) < 0.01


@pytest.mark.parametrize("count", [0, 1])
def test_fewer_than_two_photos_place_no_point(count):
    assert "photo" in locate_point(looks(np.zeros(3), np.random.default_rng(2))[:count])


def test_parallel_rays_place_no_point():
    ray = np.array([0.0, 0.0, 1.0])
    sights = [Sight(f"{k}.jpg", np.array([0.01 * k, 0.0, 0.0]), ray, FOCAL) for k in range(3)]
    assert "parallel" in locate_point(sights)


def test_a_point_behind_its_cameras_is_none():
    sights = [
        Sight(f"{k}.jpg", np.array([x, 0.0, 0.0]), np.array([x, 0.0, 1.0]) / np.hypot(x, 1), FOCAL)
        for k, x in enumerate((-1.0, 1.0))
    ]
    assert isinstance(locate_point(sights), str)


def test_marks_are_of_the_file_at_its_full_size(tmp_path):
    Image.new("RGB", (120, 80)).save(tmp_path / "a.jpg")
    small = Photo("a.jpg", 60, 40, "one camera", needs_copy=True)
    assert layout_scale(small, tmp_path) == 0.5
    assert layout_scale(replace(small, needs_copy=False), tmp_path) == 1.0
    assert layout_scale(replace(small, name="gone.jpg"), tmp_path) == 1.0


@pytest.mark.parametrize("turn", [0, 90, 180, 270])
def test_pixels_of_the_upright_photo_are_found_as_it_is_laid_out(turn):
    laid_out = np.zeros((40, 60), np.uint8)
    laid_out[11, 47] = 255
    upright = np.asarray(Image.fromarray(laid_out).rotate(-turn, expand=True))
    row, column = np.argwhere(upright)[0]
    photo = Photo("a.jpg", 60, 40, "one camera", turn_deg=turn)
    assert unrotate_pixels(photo, np.array([[column + 0.5, row + 0.5]])).tolist() == [[47.5, 11.5]]
