"""Pairs through a long lens, where F does not show how far the camera has turned."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sfm_app.camera.models import camera_matrix
from sfm_app.geometry.epipolar import cross_matrix, eight_point
from sfm_app.posegraph.graph import refine_direction
from sfm_app.posegraph.pair_pose import (
    TURNS_DEG,
    Pair,
    estimate_pose,
    planar_starts,
    points_ahead,
    refine_pose,
    turned_starts,
)
from sfm_app.types import Calibration, EpipolarFit

K = camera_matrix(3300.0, 3300.0, 320.0, 240.0)
CAMERA = Calibration(K, 640, 480, "zero-curves", True)


def orbit_pair(seed, turn_deg, points=150, noise_px=0.3, roll_deg=0.0):
    """A thing of unit size seen from 9 units away, before and after a turn about it."""
    rng = np.random.default_rng([seed, 7])
    X = rng.uniform(-0.5, 0.5, (points, 3))
    turn = Rotation.from_euler("zyx", [roll_deg, turn_deg, 3.0], degrees=True).as_matrix()
    away = np.array([0.0, 0.0, 9.0])
    views = []
    for R in (np.eye(3), turn):
        x = (X @ R.T + away) @ K.T
        views.append(x[:, :2] / x[:, 2:] + rng.normal(0.0, noise_px, (points, 2)))
    t = away - turn @ away
    F = eight_point(*views)
    return Pair(tuple(views), (CAMERA, CAMERA), 1.5), F, turn, t / np.linalg.norm(t)


def errors_deg(R, t, true_R, true_t):
    return np.degrees(Rotation.from_matrix(R @ true_R.T).magnitude()), np.degrees(np.arccos(np.clip(t @ true_t, -1, 1)))


@pytest.mark.parametrize("turn_deg", [-40.0, -20.0, 10.0, 25.0, 60.0])
@pytest.mark.parametrize("roll_deg", [0.0, 100.0])
def test_the_nearest_of_the_starts_is_near(turn_deg, roll_deg):
    pair, F, R, t = orbit_pair(1, turn_deg, noise_px=0.0, roll_deg=roll_deg)
    found = [errors_deg(*start, R, t) for start in turned_starts(points_ahead(pair.lines), K.T @ F @ K)]

    assert len(found) == len(TURNS_DEG)
    nearest = min(found)
    gaps = np.diff(sorted(TURNS_DEG))
    assert 0.0 < nearest[0] < 0.5 * gaps.max() + 3.0
    assert nearest[1] < 12.0
    assert max(found)[0] > 40.0


@pytest.mark.parametrize("turned_deg", [-60.0, 90.0])
@pytest.mark.parametrize("seed", range(4))
def test_where_F_turns_the_camera_elsewhere_the_pair_is_posed_all_the_same(seed, turned_deg):
    """Through a long lens all turns about the same axis have nearly the same epipolar lines."""
    pair, _, R, t = orbit_pair(seed, 23.0)
    wrong = Rotation.from_euler("zyx", [0.0, turned_deg, np.copysign(3.0, turned_deg)], degrees=True).as_matrix()
    E = cross_matrix(np.array([0.0, 0.0, 9.0]) - wrong @ [0.0, 0.0, 9.0]) @ wrong
    fit = EpipolarFit(np.linalg.inv(K).T @ E @ np.linalg.inv(K), np.ones(150, bool), np.ones(150), 10, 0.5)

    alone = refine_pose(pair.lines, *pair.initial_pose(fit))
    pose = estimate_pose(pair, fit)

    assert errors_deg(*alone, R, t)[0] > 20.0
    assert 0.0 < errors_deg(pose.R, pose.t, R, t)[0] < 2.0
    assert pose.in_front == 1.0


@pytest.mark.parametrize("seed", range(3))
def test_one_of_the_poses_that_a_plane_allows_is_the_right_one(two_views, seed):
    views = two_views(seed, scene="wall")
    found = [views.errors_deg(*start).max() for start in planar_starts(views.rays)]

    assert 2 <= len(found) <= 4
    assert 0.0 < min(found) < 1.5
    assert max(found) > 10.0


def test_too_few_matches_and_those_on_a_line_have_no_plane():
    line = np.column_stack([np.linspace(0, 1, 20)] * 4)
    assert list(planar_starts(line[:7])) == []
    assert all(np.isfinite(R).all() and np.isfinite(t).all() for R, t in planar_starts(line))


def test_matches_without_extent_give_no_starts():
    used = np.zeros((5, 4))
    assert list(turned_starts(used, np.zeros((3, 3)))) == []
    assert list(turned_starts(used, cross_matrix(np.array([0.0, 0.0, 1.0])))) == []


def test_with_the_rotation_held_the_direction_is_found_from_nearby():
    pair, _, R, t = orbit_pair(3, 20.0)
    aside = Rotation.from_rotvec([0.0, 0.1, 0.1]).as_matrix() @ t
    for sign in (1.0, -1.0):
        found = refine_direction(pair, R, sign * aside)
        assert 0.0 < np.degrees(np.arccos(sign * found @ t)) < 1.0
        assert np.linalg.norm(found) == pytest.approx(1.0)
