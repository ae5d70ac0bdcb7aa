"""The photos of the dense workspace at another size show the same directions."""

import cv2
import numpy as np
import pytest

from sfm_app.colmap.backend import pycolmap
from sfm_app.colmap.perspective.larger_views import LargerViews
from sfm_app.photos import save_mask
from tests.unit.colmap.test_wide_views import CAMERAS, NAMES, SIZE, colors_of, fill, make_place


@pytest.fixture
def plain(tmp_path, monkeypatch):
    """Photos of a lens that one view is enough for."""
    monkeypatch.setitem(CAMERAS, "plain", ("OPENCV", [420.0, 415.0, 241.0, 158.0, 0.05, -0.01, 0.0, 0.0]))
    make_place(tmp_path, "plain")
    return tmp_path


def poses(place):
    images = pycolmap.Reconstruction(place / "sparse").images.values()
    return {image.name: image.cam_from_world().matrix()[:, :3] for image in images}


def errors(gray, K, R, used):
    """How far gray levels are from those of the directions."""
    y, x = np.mgrid[: gray.shape[0], : gray.shape[1]] + 0.5
    rays = np.stack([x, y, np.ones_like(x)], -1) @ np.linalg.inv(K).T @ R
    expected = cv2.cvtColor(colors_of(rays), cv2.COLOR_RGB2GRAY)
    return np.abs(gray.astype(int) - expected)[used]


@pytest.mark.parametrize("side", [240, 2000])
def test_photos_of_a_plain_lens_keep_their_names(plain, side):
    found = LargerViews(plain / "sparse", plain / "photos", None, side)

    assert found.photos(["c.png", "a.png"]) == ["a.png", "c.png"]
    for photo in NAMES:
        ((name, K, gray, used),) = found.render(photo)
        assert name == photo and max(gray.shape) <= side
        assert max(gray.shape) > 0.9 * min(side, SIZE[0])
        assert used.mean() > 0.98 and np.quantile(errors(gray, K, poses(plain)[photo], used), 0.999) < 6


def test_views_of_a_fisheye_are_those_of_the_workspace(tmp_path):
    make_place(tmp_path, "fisheye")
    _, views = fill(tmp_path)
    found = LargerViews(tmp_path / "sparse", tmp_path / "photos", None, 120)

    assert found.photos([views[0].name]) == [NAMES[0]]
    rendered = {name: rest for photo in NAMES for name, *rest in found.render(photo)}
    assert sorted(rendered) == sorted(view.name for view in views)
    for view in views:
        K, gray, used = rendered[view.name]
        assert max(gray.shape) <= 120
        assert np.quantile(errors(gray, K, view.R, used), 0.99) < 12


def test_masked_pixels_are_not_used(plain):
    mask = np.ones(SIZE[::-1], bool)
    mask[:, :200] = False
    for photo in NAMES:
        save_mask(plain / "masks", photo, mask)

    ((_, _, gray, used),) = LargerViews(plain / "sparse", plain / "photos", plain / "masks", 480).render("a.png")

    share = np.mean(used, axis=0)
    assert gray.shape == used.shape
    assert share[:150].max() == 0.0 and share[-200:].min() > 0.9
