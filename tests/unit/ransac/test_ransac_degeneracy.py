"""Planes and pure rotations are named; scenes with depth are not."""

import numpy as np
import pytest

from sfm_app.geometry.camera import camera_matrix
from sfm_app.ransac import ESTIMATORS
from sfm_app.settings import EpipolarSettings
from sfm_app.synthetic.cameras import axis_rotation
from sfm_app.synthetic.correspondences import PairOptions, make_pair
from sfm_app.types import EpipolarFit

SIZE, FOCAL = np.array([1000.0, 750.0]), 900.0
K = camera_matrix(FOCAL, FOCAL, *(SIZE / 2))


def views(scene, seed, *, sigma_px=0.3, outliers=60, off_plane=0):
    """Matches of a plane, a pure rotation, or a plane with some points in front of it, and outliers."""
    rng = np.random.default_rng(seed)
    x1 = rng.uniform(size=(900, 2)) * SIZE
    rays = np.column_stack([x1, np.ones(900)]) @ np.linalg.inv(K).T
    normal = np.array([0.3, -0.2, 1.0])
    X = rays * (5.0 / (rays @ normal))[:, None]
    X[:off_plane] *= rng.uniform(0.5, 0.9, (off_plane, 1))
    R = axis_rotation(np.array([0.2, 1.0, 0.1]) / np.linalg.norm([0.2, 1.0, 0.1]), 12.0)
    t = np.zeros(3) if scene == "rotation" else np.array([-0.9, 0.1, 0.3])
    x2 = (X @ R.T + t) @ K.T
    x2 = x2[:, :2] / x2[:, 2:]
    seen = ((x2 > 0) & (x2 < SIZE)).all(axis=1)
    x1, x2 = (x[seen] + rng.normal(scale=sigma_px, size=x[seen].shape) for x in (x1, x2))
    wrong = rng.uniform(size=(2, outliers, 2)) * SIZE
    return np.vstack([x1, wrong[0]]), np.vstack([x2, wrong[1]])


@pytest.mark.parametrize("scene", ["planar", "rotation"])
@pytest.mark.parametrize("seed", range(5))
def test_degenerate_pairs_are_named(scene, seed):
    fit = ESTIMATORS["lev-ransac"][0](*views(scene, seed), EpipolarSettings(), seed)
    assert isinstance(fit, EpipolarFit)
    assert fit.degeneracy == scene


@pytest.mark.parametrize("seed", range(5))
def test_a_plane_with_enough_in_front_of_it_is_no_plane(seed):
    fit = ESTIMATORS["lev-ransac"][0](*views("planar", seed, off_plane=200), EpipolarSettings(), seed)
    assert fit.degeneracy == ""


@pytest.mark.parametrize("seed", range(10))
def test_scenes_with_depth_are_not_degenerate(seed):
    pair = make_pair(PairOptions(points=400, outliers=0.3, sigma_px=0.5, width=1000, height=750, focal_px=900), seed)
    fit = ESTIMATORS["lev-ransac"][0](pair.x1, pair.x2, EpipolarSettings(), seed)
    assert fit.degeneracy == ""
