"""A camera that moves while its rows are read."""

import itertools

import numpy as np
import pytest

from benchmarks.synthetic.walks import WalkOptions, project_through_shutter, row_poses, walk
from sfm_app.errors import ConfigError
from sfm_app.synthetic.cameras import camera_center, make_camera

CAMERA = make_camera(640, 480)


def turn_deg(a, b):
    return np.degrees(np.arccos(np.clip((np.trace(a[:, :3] @ b[:, :3].T) - 1.0) / 2.0, -1.0, 1.0)))


def test_a_walk_without_shaking_goes_straight_on_at_its_speed():
    path = walk(WalkOptions(seconds=2.0, speed=1.4, shake=0.0, heading_deg=90.0))

    first, last = path.poses(np.array([0.0, 2.0]))

    assert camera_center(last) - camera_center(first) == pytest.approx([2.8, 0.0, 0.0], abs=1e-9)
    assert turn_deg(first, last) == pytest.approx(0.0, abs=1e-5)


def test_the_fastest_turn_is_as_fast_as_asked():
    path = walk(WalkOptions(seconds=4.0, swing_deg_s=60.0, shake=0.0))
    poses = path.poses(np.linspace(0.0, 4.0, 401))

    rates = [turn_deg(a, b) / 0.01 for a, b in itertools.pairwise(poses)]

    assert 59.0 < max(rates) < 61.0


def test_a_hand_shakes_by_centimeters_and_degrees():
    smooth, shaken = (walk(WalkOptions(shake=shake)).poses(np.linspace(0.0, 4.0, 81)) for shake in (0.0, 1.0))

    off = [np.linalg.norm(camera_center(a) - camera_center(b)) for a, b in zip(smooth, shaken, strict=True)]
    turned = [turn_deg(a, b) for a, b in zip(smooth, shaken, strict=True)]

    assert 0.01 < np.median(off) < 0.1
    assert 0.5 < np.median(turned) < 5.0


def test_the_seed_determines_the_phases():
    times = np.array([0.3, 1.7])
    first, again, other = (walk(WalkOptions(), seed).poses(times) for seed in (1, 1, 2))

    assert np.array_equal(first, again)
    assert not np.allclose(first, other, atol=1e-3)


def test_the_middle_row_is_seen_from_the_pose_of_the_frame():
    path = walk(WalkOptions(swing_deg_s=60.0))

    rows = row_poses(path, 1.0, 0.03, 481)

    assert rows[240] == pytest.approx(path.poses(np.array([1.0]))[0], abs=1e-12)
    assert rows[0] == pytest.approx(path.poses(np.array([1.0 - 0.015 * 480 / 481]))[0], abs=1e-12)


def test_a_point_is_seen_from_the_pose_of_its_own_row():
    path, readout = walk(WalkOptions(swing_deg_s=90.0)), 0.03
    (middle,) = path.poses(np.array([1.0]))
    points = (np.random.default_rng(0).uniform([-1, -1, 4], [1, 1, 7], (50, 3)) - middle[:, 3]) @ middle[:, :3]

    x = project_through_shutter(CAMERA, path, 1.0, readout, points)

    inside = np.all((x > 0) & (x < (640, 480)), axis=1)
    assert np.count_nonzero(inside) > 10
    for point, (column, row) in zip(points[inside], x[inside], strict=True):
        (pose,) = path.poses(np.array([1.0 + readout * (row / 480 - 0.5)]))
        seen = CAMERA.K @ (pose[:, :3] @ point + pose[:, 3])
        assert seen[:2] / seen[2] == pytest.approx([column, row], abs=1e-4)
    still = project_through_shutter(CAMERA, path, 1.0, 0.0, points)
    assert 1.0 < np.median(np.linalg.norm(x - still, axis=1)) < 20.0


def test_points_behind_the_camera_are_nowhere():
    path = walk(WalkOptions(shake=0.0))

    x = project_through_shutter(CAMERA, path, 0.0, 0.02, np.array([[0.0, 1.5, 5.0], [0.0, 1.5, -5.0]]))

    assert np.isnan(x[0]).all() and np.isfinite(x[1]).all()


@pytest.mark.parametrize("wrong", [{"seconds": 0.0}, {"speed": -1.0}, {"swing_period_s": 0.0}, {"shake": -0.1}])
def test_what_is_out_of_range_is_refused(wrong):
    with pytest.raises(ConfigError, match=next(iter(wrong))):
        WalkOptions(**wrong)
