"""Points marked in several photos: exact, with a covariance that covers the error, and without wrong marks."""

import numpy as np
import pytest

from sfm_app.frame.sighted_points import Sight, SightedPoint, locate_point

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
        assert found.left_out == ()
        off = found.place - point
        normalized.append(off @ np.linalg.inv(found.covariance) @ off / 3)
    assert 0.6 < np.mean(normalized) < 1.9


def test_wrong_marks_are_left_out_and_named():
    rng = np.random.default_rng(1)
    for _ in range(20):
        point = rng.normal(size=3)
        found = locate_point(looks(point, rng, wrong=(1, 4)))

        assert isinstance(found, SightedPoint)
        assert found.left_out == ("1.jpg", "4.jpg")
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
