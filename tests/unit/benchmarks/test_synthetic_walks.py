"""Walks, orbits, panoramas, a camera that moves while its rows are read, and matches without pictures."""

import numpy as np
import pytest

from benchmarks.synthetic import walks
from benchmarks.synthetic.matches import LEAST_DEPARTURE_PX, TownOptions, make_town_graph, make_two_motions
from sfm_app.errors import ConfigError
from sfm_app.geometry.epipolar import sampson_distance
from sfm_app.synthetic.cameras import make_camera
from sfm_app.synthetic.correspondences import PairOptions
from sfm_app.types.scene import camera_center


def miss_of_axes(views):
    """(N,) how far each optical axis passes the point that is nearest to all of them."""
    poses = np.array(list(views.cam_from_world.values()))
    centers = np.array([camera_center(pose) for pose in poses])
    axes = poses[:, 2, :3]
    away = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    meeting = np.linalg.solve(away.sum(axis=0), np.einsum("nij,nj->i", away, centers))
    return np.linalg.norm(np.einsum("nij,nj->ni", away, meeting - centers), axis=1)


@pytest.mark.parametrize(("photos", "sweep_deg"), [(12, 80.0), (8, 360.0)])
def test_in_an_orbit_all_axes_meet_at_one_distance(photos, sweep_deg):
    aim = np.array([0.5, 1.0, -0.3])
    views = walks.orbit(make_camera(96, 64), photos, sweep_deg, distance=4.0, aim=tuple(aim))
    poses = np.array(list(views.cam_from_world.values()))
    centers = np.array([camera_center(pose) for pose in poses])
    assert len(poses) == photos and miss_of_axes(views).max() < 1e-9
    assert np.allclose(np.linalg.norm(centers - aim, axis=1), 4.0) and np.allclose(centers[:, 1], 1.0)
    assert np.allclose(poses[:, 1, :3], [0, -1, 0]), "upright"
    steps = np.linalg.norm(np.diff(centers, axis=0), axis=1)
    assert np.allclose(steps, 8.0 * np.sin(np.radians(sweep_deg / photos / 2)))


CAMERA = make_camera(640, 480)


def turn_deg(a, b):
    return np.degrees(np.arccos(np.clip((np.trace(a[:, :3] @ b[:, :3].T) - 1.0) / 2.0, -1.0, 1.0)))


def test_a_walk_without_shaking_goes_straight_on_at_its_speed():
    path = walks.walk(walks.WalkOptions(seconds=2.0, speed=1.4, shake=0.0, heading_deg=90.0))
    first, last = path.poses(np.array([0.0, 2.0]))
    assert camera_center(last) - camera_center(first) == pytest.approx([2.8, 0.0, 0.0], abs=1e-9)
    assert turn_deg(first, last) == pytest.approx(0.0, abs=1e-5)


def test_the_middle_row_is_seen_from_the_pose_of_the_frame():
    path = walks.walk(walks.WalkOptions(swing_deg_s=60.0))
    rows = walks.row_poses(path, 1.0, 0.03, 481)
    assert rows[240] == pytest.approx(path.poses(np.array([1.0]))[0], abs=1e-12)
    assert rows[0] == pytest.approx(path.poses(np.array([1.0 - 0.015 * 480 / 481]))[0], abs=1e-12)


def test_a_point_is_seen_from_the_pose_of_its_own_row():
    path, readout = walks.walk(walks.WalkOptions(swing_deg_s=90.0)), 0.03
    (middle,) = path.poses(np.array([1.0]))
    points = (np.random.default_rng(0).uniform([-1, -1, 4], [1, 1, 7], (50, 3)) - middle[:, 3]) @ middle[:, :3]
    x = walks.project_through_shutter(CAMERA, path, 1.0, readout, points)
    inside = np.all((x > 0) & (x < (640, 480)), axis=1)
    assert np.count_nonzero(inside) > 10
    for point, (column, row) in zip(points[inside], x[inside], strict=True):
        (pose,) = path.poses(np.array([1.0 + readout * (row / 480 - 0.5)]))
        seen = CAMERA.K @ (pose[:, :3] @ point + pose[:, 3])
        assert seen[:2] / seen[2] == pytest.approx([column, row], abs=1e-4)
    still = walks.project_through_shutter(CAMERA, path, 1.0, 0.0, points)
    assert 1.0 < np.median(np.linalg.norm(x - still, axis=1)) < 20.0


def test_points_behind_the_camera_are_nowhere():
    path = walks.walk(walks.WalkOptions(shake=0.0))
    x = walks.project_through_shutter(CAMERA, path, 0.0, 0.02, np.array([[0.0, 1.5, 5.0], [0.0, 1.5, -5.0]]))
    assert np.isnan(x[0]).all() and np.isfinite(x[1]).all()


@pytest.mark.parametrize("seed", range(8))
def test_each_motion_has_its_own_epipolar_geometry(seed):
    scene = make_two_motions(PairOptions(points=300, outliers=0.1), 0.3, seed)
    pair, moving = scene.pair, scene.is_moving
    to_scene = sampson_distance(pair.F, pair.exact_x1, pair.exact_x2)
    to_object = sampson_distance(scene.moving_F, pair.exact_x1, pair.exact_x2)
    assert to_scene[~moving].max() < 1e-8 and to_object[moving].max() < 1e-8
    assert np.median(to_scene[moving]) >= LEAST_DEPARTURE_PX
    assert np.median(to_object[~moving]) > 1.0
    assert np.linalg.norm(scene.moving_F) == pytest.approx(1.0)
    for x in (pair.exact_x1, pair.exact_x2):
        assert x.min() >= 0 and x.max() <= 512


@pytest.mark.parametrize(("moving", "outliers"), [(0.1, 0.0), (0.25, 0.2), (0.4, 0.1)])
def test_shares_are_those_asked_for_and_rows_are_mixed(moving, outliers):
    scene = make_two_motions(PairOptions(outliers=outliers), moving, seed=3)
    wrong = ~scene.pair.is_inlier & ~scene.is_moving
    assert len(scene.pair.x1) == 1200
    assert np.count_nonzero(scene.is_moving) == round(1200 * moving)
    assert np.count_nonzero(wrong) == round(1200 * outliers)
    assert not scene.pair.is_inlier[scene.is_moving].any()
    assert abs(scene.is_moving[:600].mean() - moving) < 0.06


@pytest.mark.parametrize(("moving", "outliers"), [(0.0, 0.1), (0.5, 0.0), (0.4, 0.2), (1.0, 0.0)])
def test_the_still_scene_must_dominate(moving, outliers):
    with pytest.raises(ConfigError, match="share above 0 and below"):
        make_two_motions(PairOptions(outliers=outliers), moving, seed=0)


def test_no_keypoint_has_two_matches_in_a_photo_and_some_matches_are_wrong():
    town = make_town_graph(TownOptions(photos=40, neighbors=8, look_alikes=0.02), 0)
    assert all(len(np.unique(rows[:, side])) == len(rows) for rows in town.matches.matches.values() for side in (0, 1))
    right = np.concatenate([fit.inliers for pair, fit in town.views.fits.items() if pair not in town.look_alikes])
    assert 0.65 < right.mean() < 0.85
