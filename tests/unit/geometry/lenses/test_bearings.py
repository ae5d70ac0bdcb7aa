"""Bearing vectors of every projection: they meet the pixels that they come from, with the right derivatives."""

import numpy as np
import pytest

from sfm_app.camera.bearings import bearings, depths_along, fold_angle, pixels_per_radian, project
from sfm_app.types import Calibration

K = np.array([[200.0, 0.0, 400.0], [0.0, 210.0, 300.0], [0.0, 0.0, 1.0]])
CAMERAS = {
    "perspective": Calibration(K, 800, 600, "test", True),
    "fisheye": Calibration(K, 800, 600, "test", True, projection="fisheye", fisheye=(0.08, -0.01, 0.002, 0.0)),
    "equirectangular": Calibration(K, 800, 600, "test", True, projection="equirectangular"),
}
PIXELS = np.random.default_rng(0).uniform([20.0, 20.0], [780.0, 580.0], (200, 2))
STEP = 1e-4


@pytest.mark.parametrize("name", CAMERAS)
def test_a_bearing_is_seen_at_its_pixel(name: str) -> None:
    lines = bearings(PIXELS, CAMERAS[name])
    for length in (0.1, 7.0):
        assert np.abs(project(length * lines[:, :3], CAMERAS[name]) - PIXELS).max() < 1e-9
        assert np.allclose(depths_along(length * lines[:, :3], CAMERAS[name]), length)


@pytest.mark.parametrize("name", CAMERAS)
def test_derivatives_agree_with_differences(name: str) -> None:
    lines = bearings(PIXELS, CAMERAS[name])
    for axis, columns in enumerate((slice(3, 6), slice(6, 9))):
        moved = bearings(PIXELS + STEP * np.eye(2)[axis], CAMERAS[name])
        assert np.abs((moved - lines)[:, :3] / STEP - lines[:, columns]).max() < 1e-6


def test_a_fisheye_looks_backwards() -> None:
    wide = Calibration(K, 800, 600, "test", True, projection="fisheye", fisheye=(0.0, 0.0, 0.0, 0.0))
    behind = np.array([[np.sin(1.9), 0.0, np.cos(1.9)]])
    assert np.allclose(project(behind, wide), [[400.0 + 200.0 * 1.9, 300.0]])
    assert np.allclose(bearings(project(behind, wide), wide)[:, :3], behind)


def test_a_lens_that_folds_shows_nothing_beyond_its_fold() -> None:
    folding = Calibration(K, 800, 600, "test", True, projection="fisheye", fisheye=(-0.2, 0.0, 0.0, 0.0))
    fold = fold_angle(folding)
    assert 1.1 < fold < np.sqrt(1.0 / 0.6)
    for theta, seen in ((fold - 0.05, True), (fold + 0.05, False)):
        assert np.isfinite(project(np.array([[np.sin(theta), 0.0, np.cos(theta)]]), folding)).all() == seen


def test_a_perspective_camera_sees_nothing_behind_it() -> None:
    assert np.isnan(project(np.array([[0.1, 0.2, -1.0]]), CAMERAS["perspective"])).all()


def test_the_scale_of_a_perspective_camera_is_its_mean_focal() -> None:
    assert pixels_per_radian(bearings(PIXELS, CAMERAS["perspective"])) == pytest.approx(205.0)
