"""Jacobi's rotations against LAPACK."""

import numpy as np
import pytest

from sfm_app.fundamental.solvers import decompose_symmetric


def solve(matrix):
    size = len(matrix)
    values, vectors = np.empty(size), np.empty((size, size))
    decompose_symmetric(matrix.copy(), values, vectors)
    return values, vectors


def check(matrix, expected):
    values, vectors = solve(matrix)
    scale = np.abs(expected).max()
    np.testing.assert_allclose(values, np.sort(expected), rtol=0, atol=1e-14 * len(matrix) * scale)
    np.testing.assert_allclose(vectors.T @ vectors, np.eye(len(matrix)), atol=1e-13)
    np.testing.assert_allclose(matrix @ vectors, vectors * values, rtol=0, atol=1e-13 * len(matrix) * scale)


@pytest.mark.parametrize("size", range(2, 10))
@pytest.mark.parametrize("seed", range(5))
def test_values_and_vectors_are_those_of_numpy(size, seed):
    A = np.random.default_rng([size, seed]).normal(size=(size, size))
    matrix = A + A.T
    expected = np.linalg.eigh(matrix)
    check(matrix, expected.eigenvalues)
    # with signs free: every vector is the same direction
    np.testing.assert_allclose(np.abs((solve(matrix)[1] * expected.eigenvectors).sum(axis=0)), 1, atol=1e-9)


@pytest.mark.parametrize(
    "values", [[1, 1], [0, 0, 5], [2, 2, 2], [-3, -3, 1, 1], [0] * 5 + [1] * 4, [1e-12, 1e-6, 1, 1e6], [0, 0, 0]]
)
def test_repeated_and_far_apart_values(values):
    for seed in range(5):
        Q = np.linalg.qr(np.random.default_rng(seed).normal(size=(len(values),) * 2))[0]
        matrix = Q * np.array(values, dtype=float) @ Q.T
        check((matrix + matrix.T) / 2, np.array(values, dtype=float))


def test_diagonal_matrices_are_only_sorted():
    values, vectors = solve(np.diag([3.0, -1.0, 2.0]))
    assert values.tolist() == [-1, 2, 3]
    assert vectors.tolist() == [[0, 0, 1], [1, 0, 0], [0, 1, 0]]


def test_what_is_not_finite_ends():
    values, _ = solve(np.full((9, 9), np.nan))
    assert np.isnan(values).all()


@pytest.mark.parametrize("scale", [1e-60, 1e60])
def test_scale_does_not_matter(scale):
    A = np.random.default_rng(1).normal(size=(9, 9))
    plain, scaled = solve(A @ A.T), solve(scale * (A @ A.T))
    np.testing.assert_allclose(scaled[0], scale * plain[0], rtol=1e-10)
    np.testing.assert_allclose(scaled[1], plain[1], atol=1e-10)
