"""Scenes for tests of fundamental matrices."""

import numpy as np

from sfm_app.camera.models import camera_matrix
from sfm_app.geometry.epipolar import fundamental_from_pose
from sfm_app.synthetic.correspondences import random_rotation

UNIT = 400.0
"""Pixels per unit of length."""
CAMERA = camera_matrix(900 / UNIT, 900 / UNIT, 0, 0)


def mapped(H, x):
    h = np.column_stack([x, np.ones(len(x))]) @ H.T
    return h[:, :2] / h[:, 2:]


def plane_scene(seed, *, on_plane, off_plane=0, outliers=0, sigma_px=0.0):
    """Matches in random order, H of the plane, F, and which matches lie in front of the plane."""
    rng = np.random.default_rng([seed, 31])
    R, t, n = random_rotation(rng, 20.0), np.array([0.5, 0.1, 0.1]), rng.normal((0, 0, -1), 0.2)
    count = on_plane + off_plane
    x1 = rng.uniform(-1, 1, (count, 2))
    rays = np.column_stack([x1, np.ones(count)]) @ np.linalg.inv(CAMERA).T
    depth = -1 / (rays @ n)
    depth[on_plane:] *= rng.uniform(0.5, 0.8, off_plane)
    x2 = ((rays * depth[:, None]) @ R.T + t) @ CAMERA.T
    points = np.column_stack([x1, x2[:, :2] / x2[:, 2:]]) + rng.normal(0, sigma_px / UNIT, (count, 4))
    points = np.vstack([points, rng.uniform(-1, 1, (outliers, 4))])
    order, row = rng.permutation(len(points)), np.arange(len(points))
    H = CAMERA @ (R - np.outer(t, n)) @ np.linalg.inv(CAMERA)
    F = fundamental_from_pose(CAMERA, CAMERA, R, t)
    return np.asfortranarray(points[order]), H, F, ((row >= on_plane) & (row < count))[order]
