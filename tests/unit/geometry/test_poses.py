"""Rotations, poses and similarities."""

from itertools import combinations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from sfm_app.errors import NumericalError
from sfm_app.geometry.poses import Similarity, draw_pairs, retract, robust_similarity, umeyama, write_essential


def random_similarity(rng):
    R = Rotation.random(random_state=int(rng.integers(2**31))).as_matrix()
    return Similarity(float(np.exp(rng.uniform(-3, 3))), R, rng.normal(size=3) * 10)


@given(seed=st.integers(0, 2**32 - 1), flat=st.booleans())
@settings(deadline=None)
def test_umeyama_finds_the_similarity(seed, flat):
    rng = np.random.default_rng(seed)
    true = random_similarity(rng)
    a = rng.normal(size=(8, 3)) * [1.0, 1.0, 0.0 if flat else 1.0]
    found = umeyama(a, true(a))
    assert found.scale == pytest.approx(true.scale)
    assert np.allclose(found.R, true.R, atol=1e-6) and np.linalg.det(found.R) > 0
    assert np.allclose(found(a), true(a), atol=1e-6 * true.scale)


def test_similarities_combine_and_undo():
    rng = np.random.default_rng(1)
    first, second, x = random_similarity(rng), random_similarity(rng), rng.normal(size=(5, 3))
    assert np.allclose(second.compose(first)(x), second(first(x)))
    assert np.allclose(first.inverse()(first(x)), x)


def test_wrong_points_do_not_spoil_the_robust_fit():
    rng = np.random.default_rng(2)
    true, a = random_similarity(rng), rng.normal(size=(12, 3))
    b = true(a + rng.normal(scale=1e-3, size=a.shape))
    b[:4] += true.scale * rng.normal(size=(4, 3))
    robust, plain = robust_similarity(a, b), umeyama(a, b)
    errors = [np.abs(fit(a[4:]) - b[4:]).mean() / true.scale for fit in (robust, plain)]
    assert 3e-4 < errors[0] < 3e-3 < 3e-2 < errors[1]


def test_points_that_fix_no_rotation():
    line = np.arange(5.0)[:, None] * [1.0, 2.0, 3.0]
    for few in (line, line[:2]):
        with pytest.raises(NumericalError, match="do not determine a rotation"):
            robust_similarity(few, few)


def test_thousands_of_points_with_a_third_wrong_take_no_memory():
    rng = np.random.default_rng(5)
    true = Similarity(2.5, np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]), np.array([1.0, 2.0, 3.0]))
    a = rng.normal(size=(3000, 3))
    b = true(a) + rng.normal(scale=1e-3, size=a.shape)
    b[:1000] = rng.normal(size=(1000, 3))
    found = robust_similarity(a, b)
    assert abs(found.scale - true.scale) < 1e-3 and np.allclose(found.R, true.R, atol=1e-3)
    assert np.allclose(found.t, true.t, atol=1e-3)


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


@pytest.mark.parametrize(("count", "most"), [(0, 5), (1, 5), (2, 5), (5, 10), (6, 10), (400, 30)])
def test_pairs_are_all_or_some_of_them_each_once(count, most):
    every, drawn = list(combinations(range(count), 2)), [tuple(pair) for pair in draw_pairs(count, most).tolist()]
    assert drawn == every if len(every) <= most else len(drawn) == len(set(drawn)) == most and set(drawn) < set(every)
