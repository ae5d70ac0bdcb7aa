"""Relative poses as twelve numbers, and steps of five degrees of freedom."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sfm_app.geometry.poses import retract, write_essential


def pose_of(seed=0):
    rng = np.random.default_rng(seed)
    t = rng.normal(size=3)
    return np.concatenate([Rotation.from_rotvec(rng.uniform(-0.4, 0.4, 3)).as_matrix().ravel(), t / np.linalg.norm(t)])


def test_essential_is_t_cross_r():
    pose, E = pose_of(3), np.empty((3, 3))

    write_essential(pose, E)

    np.testing.assert_allclose(E, np.cross(pose[9:], pose[:9].reshape(3, 3), axisb=0, axisc=0))


@pytest.mark.parametrize("seed", range(6))
def test_a_step_turns_and_leaves_a_pose_a_pose(seed):
    rng, pose = np.random.default_rng(seed), pose_of(seed)
    step = rng.normal(size=5)
    new = retract(pose, step)
    R = new[:9].reshape(3, 3)
    np.testing.assert_allclose(R, Rotation.from_rotvec(step[:3]).as_matrix() @ pose[:9].reshape(3, 3), atol=1e-12)
    assert np.linalg.norm(new[9:]) == pytest.approx(1)
    # across: the tangent of the angle between the directions is the length of the step
    assert np.tan(np.arccos(new[9:] @ pose[9:])) == pytest.approx(np.linalg.norm(step[3:]), rel=1e-6)


def test_small_steps_are_first_order():
    for t in ([0, 0, 1.0], [0, 0, -1.0], [0.6, 0, -0.8], [1.0, 0, 0]):
        pose = np.concatenate([np.eye(3).ravel(), t])
        np.testing.assert_array_equal(retract(pose, np.zeros(5)), pose)
        across = np.array([(retract(pose, 1e-7 * e)[9:] - t) / 1e-7 for e in np.eye(5)[3:]])
        np.testing.assert_allclose(across @ across.T, np.eye(2), atol=1e-6)
        np.testing.assert_allclose(across @ t, 0, atol=1e-6)
