import numpy as np
import pytest
from scipy import sparse

from sfm_app.errors import NumericalError
from sfm_app.geometry import least_squares


def system(n, seed=0):
    rng = np.random.default_rng(seed)
    J = rng.normal(size=(3 * n, n)) * 10.0 ** rng.uniform(-4, 4, n)
    return J.T @ J, rng.normal(size=(n, 2))


def test_lapack_and_elimination_agree(monkeypatch):
    S, B = system(60)
    small = least_squares.solve_positive(S, B)

    monkeypatch.setattr(least_squares, "MOST_ELIMINATED", 10)
    large = least_squares.solve_positive(S, B)

    np.testing.assert_allclose(large, small, rtol=1e-7)
    assert not np.array_equal(large, small), "they are two ways"


def test_a_large_system_with_an_open_direction_has_a_bounded_solution(monkeypatch):
    S, B = system(40)
    S[5] = S[:, 5] = S[6] = S[:, 6] = 0.0
    S[5, 5] = S[6, 6] = S[5, 6] = S[6, 5] = 1.0

    monkeypatch.setattr(least_squares, "MOST_ELIMINATED", 10)
    found = least_squares.solve_positive(S, S @ B)

    np.testing.assert_allclose(S @ found, S @ B, rtol=1e-6, atol=1e-6 * np.abs(S @ B).max())


def test_what_is_not_finite_is_an_error(monkeypatch):
    S, B = system(20)
    S[3, 3] = np.nan

    monkeypatch.setattr(least_squares, "MOST_ELIMINATED", 10)
    with pytest.raises(NumericalError, match="NaN"):
        least_squares.solve_positive(S, B)


def test_sparse_and_dense_systems_have_the_same_solution(monkeypatch):
    rng = np.random.default_rng(0)
    rows = np.repeat(np.arange(300), 4)
    J = sparse.coo_array(
        (rng.normal(size=1200), (rows, rows // 2 + rng.integers(0, 10, 1200))), shape=(300, 160)
    ).tocsr()
    S, B = sparse.csr_array(J.T @ J + 0.01 * sparse.eye_array(160)), rng.normal(size=(160, 3))
    dense = least_squares.solve_sparse_positive(S, B)

    monkeypatch.setattr(least_squares, "MOST_ELIMINATED", 10)
    monkeypatch.setattr(least_squares, "MOST_DENSE", 10)
    found = least_squares.solve_sparse_positive(S, B)

    np.testing.assert_allclose(found, dense, rtol=1e-6, atol=1e-9)
    assert S.nnz < 0.3 * 160**2
    with pytest.raises(NumericalError, match="NaN"):
        least_squares.solve_sparse_positive(S * np.nan, B)
