"""Projection through a rolling shutter, and its derivatives."""

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.synthetic.walks import project_through_shutter
from sfm_app.bundle.normal_equations import apply_step, project
from sfm_app.bundle.rolling_shutter import move_to_middle_row, project_rows

STEP = 1e-6


@pytest.fixture(scope="module")
def seen(film):
    found = film(0.02, frames=10, swing_deg_s=60.0)
    motion = np.random.default_rng(1).normal(scale=0.003, size=(10, 6))
    return found.bundle, found.rows.share, motion


def test_without_motion_it_is_the_projection_of_a_global_shutter(seen):
    bundle, share, motion = seen

    found, plain = project_rows(bundle, share, 0.0 * motion), project(bundle)

    assert found.x == pytest.approx(plain[0], abs=1e-9)
    for ours, theirs in zip((found.by_camera, found.by_pose, found.by_point), plain[1:], strict=True):
        assert ours == pytest.approx(theirs, abs=1e-9)


@pytest.mark.parametrize("place", range(6))
def test_derivatives_by_pose_and_motion_are_those_of_the_projection(seen, place):
    bundle, share, motion = seen
    change = np.zeros((10, 6))
    change[:, place] = STEP
    found = project_rows(bundle, share, motion)

    posed = apply_step(bundle, bundle.params, change, np.zeros_like(bundle.X))
    by_pose = (project_rows(posed, share, motion).x - found.x) / STEP
    by_motion = (project_rows(bundle, share, motion + change).x - found.x) / STEP

    scale = np.abs(found.by_motion[:, :, place]).max()
    assert by_pose == pytest.approx(found.by_pose[:, :, place], abs=1e-3 * scale)
    # a turn during the readout is differentiated at its end
    assert by_motion == pytest.approx(found.by_motion[:, :, place], abs=0.02 * scale)


@pytest.mark.parametrize("place", range(3))
def test_derivatives_by_point_are_those_of_the_projection(seen, place):
    bundle, share, motion = seen
    found = project_rows(bundle, share, motion)

    moved = project_rows(replace(bundle, X=bundle.X + STEP * np.eye(3)[place]), share, motion)

    by_point = (moved.x - found.x) / STEP
    assert by_point == pytest.approx(found.by_point[:, :, place], abs=1e-3 * np.abs(found.by_point).max())


def test_points_return_to_the_time_of_the_middle_row():
    rng = np.random.default_rng(2)
    points, share, motion = rng.uniform([-2, -1, 3], [2, 1, 8], (20, 3)), rng.uniform(-0.5, 0.5, 20), rng.normal(size=6)
    still = move_to_middle_row(points, np.zeros(20), 0.03 * motion)

    assert still == pytest.approx(points)
    assert np.abs(move_to_middle_row(points, share, 0.03 * motion) - points).max() > 0.01


def test_keypoints_of_a_moving_camera_come_to_where_the_middle_pose_sees_them(film):
    """At 60 degrees per second and 20 ms the rows are up to 10 pixels apart; a fiftieth of a pixel remains."""
    found = film(0.02, frames=10, swing_deg_s=60.0, shake=0.0)
    frame, path = 5, found.path
    own = found.bundle.photo == frame
    X, time = found.bundle.X[found.bundle.point[own]], found.rows.times[frame]
    shuttered, still = (project_through_shutter(found.camera, path, time, readout, X) for readout in (0.02, 0.0))
    before, now, after = path.poses(time + np.array([-1e-3, 0.0, 1e-3]))
    turn = (after[:, :3] - before[:, :3]) @ now[:, :3].T / 2e-3
    centers = [-pose[:, :3].T @ pose[:, 3] for pose in (before, after)]
    move = -now[:, :3] @ (centers[1] - centers[0]) / 2e-3
    motion = 0.02 * np.array([turn[2, 1], turn[0, 2], turn[1, 0], *move])
    share = shuttered[:, 1] / 720 - 0.5
    rays = np.column_stack([(shuttered - found.camera.K[:2, 2]) / found.camera.K[0, 0], np.ones(len(X))])
    depth = (X @ now[:, :3].T + now[:, 3])[:, 2]

    middle = move_to_middle_row(rays * depth[:, None], share, motion)

    x = middle[:, :2] / middle[:, 2:] * found.camera.K[0, 0] + found.camera.K[:2, 2]
    assert np.abs(shuttered - still).max() > 5.0
    assert np.abs(x - still).max() < 0.3 and np.median(np.abs(x - still)) < 0.02
