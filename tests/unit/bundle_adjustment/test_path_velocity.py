"""Velocities of a camera from its path."""

import numpy as np
import pytest

from benchmarks.synthetic.walks import WalkOptions, walk
from sfm_app.bundle.rolling_shutter import FITS, local_fit_weights, path_velocities

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
    assert FITS[best] in ((7, 1), (9, 1))
    assert off[best] < 0.5 * off[0]


def test_weights_differentiate_polynomials_up_to_their_degree():
    offsets = np.array([[-0.3, -0.1, 0.0, 0.25, 0.4]])
    value, slope = local_fit_weights(offsets, 3)

    for power in range(4):
        assert value[0] @ offsets[0] ** power == pytest.approx(float(power == 0), abs=1e-12)
        assert slope[0] @ offsets[0] ** power == pytest.approx(float(power == 1), abs=1e-12)
