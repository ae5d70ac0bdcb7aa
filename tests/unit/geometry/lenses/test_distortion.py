"""Lenses with all terms: undone as they were done."""

import numpy as np
import pytest

from sfm_app.camera import bearings
from sfm_app.camera.bearings import fold_radius, radial_factor, undistort
from sfm_app.camera.projection import project_points

TERMS = np.array([-0.1, 0.02, 0.001, -0.002, 0.01, 0.02, -0.001, 0.001])
FAMILIES = {"perspective": 0, "fisheye": 1}


@pytest.mark.parametrize("projection", FAMILIES)
def test_undistortion_inverts_the_projection_of_bundle_adjustment(projection):
    points = np.random.default_rng(0).uniform([-0.8, -0.8, 1.0], [0.8, 0.8, 1.2], (200, 3))
    params = np.tile([1.0, 1.0, 0.0, 0.0, *TERMS], (200, 1))
    x = project_points(points, params, np.full(200, FAMILIES[projection])).x

    w = undistort(x, TERMS, projection)

    side = np.hypot(points[:, 0], points[:, 1])
    length = np.arctan2(side, points[:, 2]) if projection == "fisheye" else side / points[:, 2]
    assert np.abs(w - points[:, :2] * (length / side)[:, None]).max() < 1e-9


def test_points_beyond_the_fold_lie_on_it():
    terms = np.array([-0.3, *[0.0] * 7])
    fold = fold_radius(terms, "perspective")

    assert 0.95 < fold / np.sqrt(1.0 / 0.9) <= 1.0
    w = undistort(np.array([[0.5, 0.0], [5.0, 0.0]]), terms, "perspective")
    assert w[1, 0] == pytest.approx(fold, rel=1e-6)
    assert w[0, 0] * float(radial_factor(w[:1, 0], terms, "perspective")[0]) == pytest.approx(0.5)


@pytest.mark.parametrize("projection", FAMILIES)
@pytest.mark.parametrize("shifted", [False, True])
def test_steps_end_where_more_of_them_change_nothing(projection, shifted, monkeypatch):
    terms = TERMS * ([1.0] * 8 if shifted else [1.0, 1.0, 0.0, 0.0, 1.0, 1.0, 0.0, 0.0])
    points = np.random.default_rng(1).uniform(-1.5, 1.5, (500, 2))
    monkeypatch.setattr(bearings, "OPTIONS", bearings.UndistortionOptions(precision=0.0))
    exact = undistort(points, terms, projection)
    monkeypatch.undo()

    assert np.abs(undistort(points, terms, projection) - exact).max() <= 1e-14
