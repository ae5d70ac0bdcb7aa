import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from sfm_app.geometry.epipolar import (
    decompose_essential,
    essential_from_fundamental,
    relative_pose,
    triangulate,
    triangulation_angle_deg,
    two_view_seed,
)

angle = st.floats(-0.6, 0.6)
component = st.floats(-1, 1)


def cross(t):
    return np.array([[0, -t[2], t[1]], [t[2], 0, -t[0]], [-t[1], t[0], 0]])


def scene(seed, R, t, n=60):
    """Points before both cameras, and their normalized projections."""
    rng = np.random.default_rng(seed)
    X = rng.uniform([-2, -2, 5], [2, 2, 9], (n, 3))
    Y = X @ R.T + t
    keep = Y[:, 2] > 0.5
    X, Y = X[keep], Y[keep]
    return X, X[:, :2] / X[:, 2:], Y[:, :2] / Y[:, 2:]


@given(st.tuples(angle, angle, angle), st.tuples(component, component, component), st.integers(0, 1000))
def test_the_pose_comes_back_from_the_essential_matrix(angles, t, seed):
    t = np.array(t)
    if np.linalg.norm(t) < 0.1:
        t = np.array([1.0, 0, 0])
    t /= np.linalg.norm(t)
    R = Rotation.from_euler("xyz", angles).as_matrix()
    X, x1, x2 = scene(seed, R, t)

    found_R, found_t, found_X, in_front = relative_pose(-3.0 * cross(t) @ R, x1, x2)

    assert np.allclose(found_R, R, atol=1e-6)
    assert np.allclose(found_t, t, atol=1e-6)
    assert in_front.all()
    assert np.allclose(found_X, X, rtol=1e-3, atol=1e-3)


@given(st.tuples(angle, angle, angle), st.tuples(component, component, st.floats(0.1, 1)))
def test_all_four_poses_are_rotations_of_the_same_essential_matrix(angles, t):
    R = Rotation.from_euler("xyz", angles).as_matrix()
    E = cross(np.array(t) / np.linalg.norm(t)) @ R

    for R_i, t_i in decompose_essential(E):
        assert np.isclose(np.linalg.det(R_i), 1)
        again = cross(t_i) @ R_i
        assert np.allclose(again, E, atol=1e-8) or np.allclose(again, -E, atol=1e-8)


def test_essential_matrix_has_two_equal_singular_values():
    K1, K2 = np.diag([700.0, 710, 1]), np.diag([900.0, 890, 1])
    E = cross([0.3, 0.1, 1.0]) @ Rotation.from_euler("y", 0.2).as_matrix()
    F = np.linalg.inv(K2).T @ E @ np.linalg.inv(K1)
    rng = np.random.default_rng(0)

    found = essential_from_fundamental(F * (1 + 1e-3 * rng.normal(size=(3, 3))), K1, K2)

    assert np.allclose(np.linalg.svd(found)[1], [1, 1, 0], atol=1e-12)
    exact = essential_from_fundamental(5 * F, K1, K2)
    assert np.allclose(exact / exact[0, 1], E / E[0, 1], atol=1e-9)


def test_triangulation_of_parallel_rays_is_infinite_not_wrong():
    P1, P2 = np.eye(3, 4), np.column_stack([np.eye(3), [-1.0, 0, 0]])

    X = triangulate(P1, P2, np.array([[0.0, 0.0]]), np.array([[0.0, 0.0]]))

    assert np.abs(X).max() > 1e9
    assert triangulation_angle_deg(X, np.zeros(3), np.array([1.0, 0, 0]))[0] == pytest.approx(0, abs=1e-3)


def test_triangulation_angle_of_a_right_angle():
    assert triangulation_angle_deg(np.array([[0.5, 0, 0.5]]), np.zeros(3), np.array([1.0, 0, 0]))[0] == pytest.approx(
        90
    )


def test_a_seed_tells_a_narrow_and_a_contradictory_pair():
    def seed(t, flip=0):
        t = np.array(t)
        _, x1, x2 = scene(1, np.eye(3), t)
        x1[:flip], x2[:flip] = x2[:flip].copy(), x1[:flip].copy()  # swapped matches lie behind the cameras
        return two_view_seed(3.0 * cross(t), x1, x2)

    wide, narrow, contradictory = seed([-1.0, 0, 0]), seed([-0.05, 0, 0]), seed([-1.0, 0, 0], flip=20)

    assert 7 < wide.angle_deg < 12 and wide.in_front == 1
    assert 0.3 < narrow.angle_deg < 0.6
    assert contradictory.in_front == pytest.approx(1 - 20 / 60, abs=0.05)


def test_points_at_infinity_are_in_front_of_no_camera(monkeypatch):
    points = np.array([[np.inf] * 3, [0.1, 0.2, 3.0]])
    monkeypatch.setattr("sfm_app.geometry.epipolar.triangulate", lambda *_: points)

    in_front = relative_pose(cross([0.0, 0.0, 1.0]), np.zeros((2, 2)), np.zeros((2, 2)))[3]

    assert in_front.tolist() == [False, True]
