"""Projection through a rolling shutter, velocities of a path, and the readout of synthetic walks."""

from dataclasses import dataclass, replace

import numpy as np
import pytest

from benchmarks.synthetic.walks import Trajectory, WalkOptions, project_through_shutter, walk
from sfm_app.bundle.lens_parts import LensPriors
from sfm_app.bundle.normal_equations import POSE, Bundle, apply_step, best_step, project, reduce
from sfm_app.bundle.rolling_shutter import (
    FITS,
    Rows,
    ShutterBundle,
    apply_shutter_step,
    estimate_readout,
    move_to_middle_row,
    path_velocities,
    project_rows,
    shutter_cost,
    shutter_step,
)
from sfm_app.camera.rows import CAMERA, PERSPECTIVE
from sfm_app.synthetic.cameras import Camera, make_camera

INTERVAL_S, POINTS, DEPTHS, NOISE_PX = 0.1, 500, (2.0, 8.0), 0.3


@dataclass(frozen=True)
class Film:
    """Frames of a walk as a bundle with true poses, points and camera."""

    bundle: Bundle
    rows: Rows
    camera: Camera
    path: Trajectory


def film(readout_s, *, frames=14, seed=0, **how):
    """The frames of a walk, with a shutter of some readout in seconds."""
    rng = np.random.default_rng([seed, 5])
    camera, times = make_camera(1280, 720, focal_widths=0.8, center=(0.5, 0.5)), INTERVAL_S * np.arange(frames)
    path = walk(WalkOptions(seconds=float(times[-1]), **how), seed)
    poses = path.poses(times)
    depths = rng.uniform(*DEPTHS, (POINTS, 1))
    rays = np.column_stack([rng.uniform([0, 0], [1280, 720], (POINTS, 2)), np.ones(POINTS)])
    of = poses[rng.integers(frames, size=POINTS)]
    X = np.einsum("nji,nj->ni", of[:, :, :3], depths * (rays @ np.linalg.inv(camera.K).T) - of[:, :, 3])
    seen = [project_through_shutter(camera, path, float(time), readout_s, X) for time in times]
    shown = [np.flatnonzero(np.all((x > 0) & (x < (1280, 720)), axis=1)) for x in seen]
    counts = np.bincount(np.concatenate(shown), minlength=POINTS)
    shown = [points[counts[points] >= 3] for points in shown]
    x = np.concatenate([one[points] for one, points in zip(seen, shown, strict=True)])
    params = np.zeros((1, CAMERA))
    params[0, :4] = camera.K[0, 0], camera.K[1, 1], 640.0, 360.0
    bundle = Bundle(
        params, np.zeros(frames, np.int64), poses[:, :, :3], poses[:, :, 3], X,
        np.repeat(np.arange(frames), [len(points) for points in shown]), np.concatenate(shown),
        x + rng.normal(scale=NOISE_PX, size=x.shape), np.array([PERSPECTIVE]),
    )  # fmt: skip
    return Film(bundle, Rows(times, bundle.x[:, 1] / 720 - 0.5), camera, path)


STEP = 1e-6


@pytest.fixture(scope="module")
def seen():
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


def test_keypoints_of_a_moving_camera_come_to_where_the_middle_pose_sees_them():
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


STEP_S = 1e-3


def velocities(poses, times):
    return path_velocities(poses[:, :, :3], poses[:, :, 3], times)


def true_velocities(path, times):
    """From poses a millisecond apart."""
    moments = [path.poses(times + k * STEP_S) for k in range(-4, 5)]
    around = [np.array([poses[i] for poses in moments]) for i in range(len(times))]
    return np.array([velocities(poses, STEP_S * np.arange(9.0)).values[0, 4] for poses in around])


def test_a_turn_and_a_move_at_constant_speed_are_found_exactly():
    times = np.sort(np.random.default_rng(0).uniform(0.0, 3.0, 12))
    path = walk(WalkOptions(seconds=3.0, shake=0.0, heading_deg=90.0, look_deg=0.0))
    found = velocities(path.poses(times), times)
    for values in found.values:
        assert values == pytest.approx(np.tile([0, 0, 0, -1.4, 0, 0], (12, 1)), abs=1e-6)


def test_velocities_are_those_of_the_camera_as_accurately_as_said():
    times = 0.1 * np.arange(30)
    path = walk(WalkOptions(seconds=3.0, swing_deg_s=60.0))
    found, true = velocities(path.poses(times), times), true_velocities(path, times)
    best = found.select_most_predictive()
    off = found.select(best) - true
    assert [FITS[fit] for fit in best] == [(5, 3), (5, 3)]
    for kind in (slice(0, 3), slice(3, 6)):
        assert np.sqrt(np.mean(off[:, kind] ** 2)) < 0.1 * np.sqrt(np.mean(true[:, kind] ** 2))
        ratio = np.sqrt(np.mean(off[:, kind] ** 2) / np.mean(found.deviations()[:, kind] ** 2))
        assert 0.1 < ratio < 2.0


def test_the_order_of_the_photos_does_not_matter():
    times = 0.1 * np.arange(15)
    poses = walk(WalkOptions()).poses(times)
    mixed = np.random.default_rng(3).permutation(15)
    there, here = velocities(poses[mixed], times[mixed]), velocities(poses, times)
    assert there.values == pytest.approx(here.values[:, mixed], abs=1e-12)
    assert there.deviations() == pytest.approx(here.deviations()[mixed], abs=1e-12)


def test_where_poses_jump_about_the_path_goes_through_their_middle():
    times = 0.1 * np.arange(40)
    poses = walk(WalkOptions(seconds=4.0, shake=0.0)).poses(times)
    jumping = poses.copy()
    jumping[:, :, 3] += np.random.default_rng(0).normal(scale=0.05, size=(40, 3))
    found, moves = velocities(jumping, times), slice(3, 6)
    best = found.select_most_predictive()[1]
    off = np.abs(found.values - velocities(poses, times).values)[:, :, moves].mean(axis=(1, 2))
    assert FITS[best] in ((7, 1), (9, 1)) and off[best] < 0.5 * off[0]


SCALE_PX = 0.5


@pytest.fixture(scope="module")
def model():
    found = film(0.02, frames=9, swing_deg_s=60.0)
    rng = np.random.default_rng(4)
    velocity, offsets = rng.normal(scale=0.5, size=(9, 6)), rng.normal(scale=1e-3, size=(9, 6))
    return ShutterBundle(found.bundle, found.rows.share, 0.02, velocity, offsets)


def test_steps_lead_to_where_only_the_noise_is_left(model):
    precision = np.zeros(model.unknowns)
    offsets = slice(POSE * 9, 2 * POSE * 9)
    precision[offsets], precision[offsets.stop :] = 1e3, 1e9
    before = shutter_cost(model, SCALE_PX)

    for _ in range(6):
        pull = np.zeros_like(precision)
        pull[offsets] = -precision[offsets] * model.offsets.ravel()
        step = shutter_step(model, precision, pull, SCALE_PX, held=True)
        model = apply_shutter_step(model, step, 1.0)

    assert shutter_cost(model, SCALE_PX) < 0.1 * before and 0.2 < step.noise_px < 0.35
    assert np.abs(step.views).max() < 1e-3


def test_priors_hold_what_they_are_sure_of(model):
    precision = np.zeros(model.unknowns)
    offsets = slice(POSE * 9, 2 * POSE * 9)
    precision[offsets] = 1e12
    free = shutter_step(model, 0.0 * precision, 0.0 * precision, SCALE_PX, held=False)
    held = shutter_step(model, precision, 0.0 * precision, SCALE_PX, held=False)
    assert np.abs(free.views[offsets]).max() > 1e-4 and np.abs(held.views[offsets]).max() < 1e-6
    assert held.deviation < free.deviation


ALL = np.array([[True] * 5 + [False] * 2 + [True]])


def priors(bundle):
    return LensPriors.from_cameras(bundle.params, bundle.family, np.array([[1280.0, 720.0]]), ALL)


def ignore_shutter(bundle):
    """The bundle after an adjustment that knows of no shutter."""
    for _ in range(8):
        reduced = reduce(bundle, SCALE_PX)
        bundle = best_step(bundle, reduced, bundle.params, SCALE_PX)
    return bundle


def measure(frames, **how):
    bundle = ignore_shutter(frames.bundle)
    return estimate_readout(bundle, frames.rows, priors(bundle), ALL, **how)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("readout_s", "speed", "swing_deg_s"), [(0.01, 1.4, 30.0), (0.03, 1.4, 0.0), (-0.02, 0.7, 90.0)]
)
def test_the_readout_is_found_as_accurately_as_said(readout_s, speed, swing_deg_s):
    found = measure(film(readout_s, frames=20, speed=speed, swing_deg_s=swing_deg_s))
    assert found.readout == pytest.approx(readout_s, rel=0.15)
    assert abs(found.readout - readout_s) < 2.0 * found.deviation
    assert 0.005 * abs(readout_s) < found.deviation < abs(readout_s) / 3.0


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(2))
def test_a_global_shutter_has_no_readout(seed):
    found = measure(film(0.0, frames=20, swing_deg_s=30.0, seed=seed))
    assert abs(found.readout) < found.deviation and 1e-5 < found.deviation < 0.003


@pytest.mark.slow
def test_straight_on_with_parallel_views_tells_nothing():
    """A shutter that sees such a walk shears the scene, and nothing contradicts it."""
    found = measure(film(0.03, frames=20, shake=0.0))
    assert found.deviation > 0.01


@pytest.mark.slow
def test_poses_are_those_of_the_middle_rows():
    bent = film(0.03, frames=20, swing_deg_s=60.0)
    true, ignored = bent.bundle, ignore_shutter(bent.bundle)
    found = estimate_readout(ignored, bent.rows, priors(ignored), ALL)
    errors = [np.median(turn_errors_deg(one.R, true.R)) for one in (ignored, found.bundle)]
    assert errors[0] > 0.15 and errors[1] < 0.25 * errors[0]


def turn_errors_deg(R, S):
    """Of relative rotations of photos a second apart."""
    ours, true = (np.einsum("nij,nkj->nik", one[10:], one[:-10]) for one in (R, S))
    traces = np.einsum("nij,nij->n", ours, true)
    return np.degrees(np.arccos(np.clip((traces - 1.0) / 2.0, -1.0, 1.0)))


@pytest.mark.slow
def test_a_known_readout_is_kept():
    found = measure(film(0.02, frames=12, swing_deg_s=60.0), known=0.02)
    assert found.readout == 0.02 and found.deviation == 0.0


@pytest.mark.slow
def test_an_earlier_estimate_shortens_the_way():
    walk = film(0.02, frames=12, swing_deg_s=60.0)
    first = measure(walk)
    again = estimate_readout(first.bundle, walk.rows, priors(first.bundle), ALL, first)
    assert again.readout == pytest.approx(first.readout, abs=0.3 * first.deviation)


@pytest.mark.slow
def test_points_far_off_do_not_stop_it():
    walk = film(0.02, frames=12, swing_deg_s=60.0)
    away = np.zeros_like(walk.bundle.X)
    away[:5] = 1e9
    bundle = apply_step(walk.bundle, walk.bundle.params, np.zeros((12, 6)), away)
    found = estimate_readout(bundle, walk.rows, priors(bundle), ALL)
    assert found.readout == pytest.approx(0.02, rel=0.15)
