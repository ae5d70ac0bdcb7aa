"""How long to wait for a better model: short where matches off the plane bear it out, else long or for ever."""

import math

import numpy as np
import pytest

from sfm_app.camera.models import camera_matrix
from sfm_app.fundamental.lev_ransac import search_patience
from sfm_app.geometry.epipolar import cross_matrix, fundamental_from_pose
from sfm_app.synthetic.correspondences import random_rotation

UNIT = 400.0
THRESHOLD = 1.5 / UNIT
K = camera_matrix(900 / UNIT, 900 / UNIT, 0, 0)


def scene(seed, *, on_plane, off_plane, outliers):
    """Matches in random order with 0.3 px of noise, H of the plane and F; lengths in units of 400 px."""
    rng = np.random.default_rng([seed, 31])
    R, t, n = random_rotation(rng, 20.0), np.array([0.5, 0.1, 0.1]), rng.normal((0, 0, -1), 0.2)
    count = on_plane + off_plane
    x1 = rng.uniform(-1, 1, (count, 2))
    rays = np.column_stack([x1, np.ones(count)]) @ np.linalg.inv(K).T
    depth = -1 / (rays @ n)
    depth[on_plane:] *= rng.uniform(0.5, 0.8, off_plane)
    x2 = ((rays * depth[:, None]) @ R.T + t) @ K.T
    points = np.column_stack([x1, x2[:, :2] / x2[:, 2:]]) + rng.normal(0, 0.3 / UNIT, (count, 4))
    points = rng.permutation(np.vstack([points, rng.uniform(-1, 1, (outliers, 4))]))
    H = K @ (R - np.outer(t, n)) @ np.linalg.inv(K)
    return np.asfortranarray(points), H, fundamental_from_pose(K, K, R, t)


@pytest.mark.parametrize("seed", range(5))
def test_a_scene_with_parallax_needs_little_patience(seed):
    points, _, F = scene(seed, on_plane=150, off_plane=250, outliers=200)
    assert 1 < search_patience(points, F, THRESHOLD) < 300


@pytest.mark.parametrize("seed", range(5))
def test_a_plane_with_a_wrong_epipole_needs_much(seed):
    points, H, F = scene(seed, on_plane=200, off_plane=60, outliers=200)
    epipole = np.append(np.random.default_rng(seed).uniform(-1, 1, 2), 1.0)
    wrong = cross_matrix(epipole) @ H
    long = search_patience(points, wrong / np.linalg.norm(wrong), THRESHOLD)
    assert long > 1000
    # the right epipole has all of the matches off the plane for it
    assert 1 < search_patience(points, F, THRESHOLD) < 0.6 * long


@pytest.mark.parametrize("seed", range(5))
def test_luck_is_waited_out_for_ever(seed):
    points, _, F = scene(seed, on_plane=0, off_plane=0, outliers=400)
    assert search_patience(points, F, THRESHOLD) == math.inf
    assert search_patience(points[:7].copy("F"), F, THRESHOLD) == math.inf


def test_patience_falls_as_matches_off_the_plane_come_in():
    waits = []
    for off_plane in (0, 60, 120, 240):
        points, _, F = scene(1, on_plane=200, off_plane=off_plane, outliers=100)
        waits.append(search_patience(points, F, THRESHOLD))
    assert waits == sorted(waits, reverse=True)
    assert waits[0] > 10 * waits[-1]
