"""Sampson distances through lenses, and their derivatives."""

import numpy as np
import pytest
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation

from sfm_app.geometry.epipolar import sampson_distance
from sfm_app.geometry.poses import retract, write_essential
from sfm_app.selfcal.adjustment import ROBUST_SCALE, distances, pair_costs, pair_systems
from sfm_app.selfcal.pairs import undistort_kernel

SIGMA = 2e-3
THETAS = np.array([[0.1, 0.02, -0.03, 0.05, -0.08], [0.3, -0.04, 0.01, -0.1, 0.05]])


def pose_of(seed=0):
    rng = np.random.default_rng(seed)
    t = rng.normal(size=3)
    return np.concatenate([Rotation.from_rotvec(rng.uniform(-0.4, 0.4, 3)).as_matrix().ravel(), t / np.linalg.norm(t)])


def scene(thetas, cameras, noise, seed=0, count=40):
    """Matches (N, 4) of one pair that nearly fit `pose_of(seed)`, and how `pair_costs` wants them."""
    rng, pose = np.random.default_rng(seed), pose_of(seed)
    R, t = pose[:9].reshape(3, 3), pose[9:]
    X = np.column_stack([rng.uniform(-1.5, 1.5, (count, 2)), rng.uniform(4, 6, count)])
    views = [project(p, thetas[k]) for p, k in zip((X, X @ R.T + t), cameras, strict=True)]
    x = np.hstack(views) + noise * rng.normal(size=(count, 4))
    return x, np.array([0, count]), thetas, np.array([cameras]), pose[None]


def project(X, theta):
    f, half = np.exp(theta[0]), np.exp(0.5 * theta[3])
    rays = X[:, :2] / X[:, 2:]
    rays = rays * (1 + theta[4] * f**2 * np.sum(rays**2, axis=1, keepdims=True))
    return rays * [f / half, f * half] + theta[1:3]


def matrix(theta):
    f, half = np.exp(theta[0]), np.exp(0.5 * theta[3])
    return np.array([[f / half, 0, theta[1]], [0, f * half, theta[2]], [0, 0, 1]])


def essential_of(pose):
    E = np.empty((3, 3))
    write_essential(pose, E)
    return E


def test_without_a_lens_it_is_sampsons_distance():
    straight = THETAS * [1, 1, 1, 1, 0]
    x, *rest = scene(straight, (0, 1), 0.01)
    inverses = [np.linalg.inv(matrix(theta)) for theta in straight]
    F = inverses[1].T @ essential_of(rest[-1][0]) @ inverses[0]
    found = distances(x, *rest)
    np.testing.assert_allclose(np.abs(found), sampson_distance(F, x[:, :2], x[:, 2:]), rtol=1e-9)
    assert np.any(found > 0) and np.any(found < 0)


def test_with_a_lens_it_is_the_shortest_move_in_the_bent_photos():
    x, *rest = scene(THETAS, (0, 1), 2e-4, count=12)
    found = np.abs(distances(x, *rest))
    E = essential_of(rest[-1][0])

    def constraint(z):
        views = [undistort_kernel(z[None, 2 * k : 2 * k + 2], THETAS[k])[0] for k in range(2)]
        p, q = (np.linalg.solve(matrix(THETAS[k]), [*views[k], 1.0]) for k in range(2))
        return 1e4 * float(q @ E @ p)

    for start, distance in zip(x, found, strict=True):
        best = minimize(
            lambda z, start=start: 1e6 * np.sum((z - start) ** 2), start, method="SLSQP",
            constraints={"type": "eq", "fun": constraint}, options={"ftol": 1e-12},
        )  # fmt: skip
        assert distance == pytest.approx(np.sqrt(best.fun / 1e6), rel=0.02, abs=2e-7)
    assert found.max() > 1e-4


def test_costs_are_robust():
    x, ends, *rest = scene(THETAS, (0, 1), 3e-3)
    r2 = (distances(x, ends, *rest) / SIGMA) ** 2
    assert pair_costs(x, ends, *rest, SIGMA)[0] == pytest.approx(0.5 * np.sum(r2 / (1 + r2 / ROBUST_SCALE**2)))
    x[0] += [0.3, -0.2, 0.1, 0.4]
    far = pair_costs(x, ends, *rest, SIGMA)[0] - pair_costs(x[1:], np.array([0, 39]), *rest, SIGMA)[0]
    assert 0.95 * ROBUST_SCALE**2 / 2 < far < ROBUST_SCALE**2 / 2


@pytest.mark.parametrize("cameras", [(0, 1), (0, 0), (1, 0)])
def test_systems_are_the_derivatives_of_the_costs(cameras):
    x, ends, thetas, members, poses = scene(THETAS, cameras, SIGMA, seed=1)
    A, b = pair_systems(x, ends, thetas, members, poses, SIGMA)

    def cost(step):
        trial = thetas.copy()
        trial[cameras[0]] += step[:5]
        if cameras[0] != cameras[1]:
            trial[cameras[1]] += step[5:10]
        return pair_costs(x, ends, trial, members, retract(poses[0], step[10:])[None], SIGMA)[0]

    own = [*range(5), *(() if cameras[0] == cameras[1] else range(5, 10)), *range(10, 15)]
    numeric = np.array([(cost(1e-6 * e) - cost(-1e-6 * e)) / 2e-6 for e in np.eye(15)[own]])
    np.testing.assert_allclose(-b[0, own], numeric, rtol=2e-3, atol=1e-4 * np.abs(numeric).max())
    np.testing.assert_array_equal(A[0], A[0].T)
    unused = np.setdiff1d(range(15), own)
    assert not np.any(A[0][unused]) and not np.any(b[0, unused])
    assert np.linalg.eigvalsh(A[0]).min() > -1e-9 * np.abs(A[0]).max()


def test_a_gauss_newton_step_finds_exact_matches_again():
    x, ends, thetas, members, poses = scene(THETAS, (0, 1), 0.0, seed=2, count=100)
    start = retract(poses[0], np.array([0.01, -0.01, 0.005, 0.01, 0.01]))[None]
    before = pair_costs(x, ends, thetas, members, start, SIGMA)[0]
    for _ in range(8):
        A, b = pair_systems(x, ends, thetas, members, start, SIGMA)
        start = retract(start[0], np.linalg.solve(A[0, 10:, 10:], b[0, 10:]))[None]
    assert before > 10
    assert pair_costs(x, ends, thetas, members, start, SIGMA)[0] < 1e-10
    np.testing.assert_allclose(start, poses, atol=1e-6)
