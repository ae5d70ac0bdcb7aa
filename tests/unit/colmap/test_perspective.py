"""The photos of the dense workspace at another size show the same directions."""

import cv2
import numpy as np
import pytest

from sfm_app.colmap.dense import read_views, undistort
from sfm_app.colmap.perspective import LargerViews
from sfm_app.photos.masks import save_mask
from sfm_app.progress import SilentProgress
from tests.unit.colmap.test_wide_views import CAMERAS, NAMES, SIZE, colors_of, fill, make_place


@pytest.fixture
def plain(tmp_path, monkeypatch):
    """Photos of a lens that one view is enough for."""
    monkeypatch.setitem(CAMERAS, "plain", ("OPENCV", [420.0, 415.0, 241.0, 158.0, 0.05, -0.01, 0.0, 0.0]))
    make_place(tmp_path, "plain")
    undistort(tmp_path / "sparse", tmp_path / "photos", tmp_path / "dense", 300, 1, SilentProgress())
    return tmp_path, {view.name: view for view in read_views(tmp_path / "dense")}


def errors(gray, K, R, used):
    """How far gray levels are from those of the directions."""
    y, x = np.mgrid[: gray.shape[0], : gray.shape[1]] + 0.5
    rays = np.stack([x, y, np.ones_like(x)], -1) @ np.linalg.inv(K).T @ R
    expected = cv2.cvtColor(colors_of(rays), cv2.COLOR_RGB2GRAY)
    return np.abs(gray.astype(int) - expected)[used]


@pytest.mark.parametrize("side", [240, 2000])
def test_photos_of_a_plain_lens_keep_their_names(plain, side):
    place, views = plain
    found = LargerViews(place / "sparse", place / "photos", None, [views["c.png"], views["a.png"]], side)

    assert found.photos == ["a.png", "c.png"]
    for photo in found.photos:
        ((name, K, gray, used),) = found.render(photo)
        assert name == photo and max(gray.shape) <= side
        assert max(gray.shape) > 0.9 * min(side, SIZE[0])
        assert used.mean() > 0.98 and np.quantile(errors(gray, K, views[photo].R, used), 0.999) < 6


def test_views_of_a_fisheye_are_those_of_the_workspace(tmp_path):
    make_place(tmp_path, "fisheye")
    _, views = fill(tmp_path)
    found = LargerViews(tmp_path / "sparse", tmp_path / "photos", None, views[1:], 120)

    rendered = {name: rest for photo in found.photos for name, *rest in found.render(photo)}
    assert found.photos == sorted(NAMES) and sorted(rendered) == sorted(view.name for view in views[1:])
    for view in views[1:]:
        K, gray, used = rendered[view.name]
        assert max(gray.shape) <= 120
        assert np.quantile(errors(gray, K, view.R, used), 0.99) < 12


def test_masked_pixels_are_not_used(plain):
    place, views = plain
    mask = np.ones(SIZE[::-1], bool)
    mask[:, :200] = False
    for photo in NAMES:
        save_mask(place / "masks", photo, mask)

    larger = LargerViews(place / "sparse", place / "photos", place / "masks", [views["a.png"]], 480)
    ((_, _, gray, used),) = larger.render("a.png")

    share = np.mean(used, axis=0)
    assert gray.shape == used.shape
    assert share[:150].max() == 0.0 and share[-200:].min() > 0.9
