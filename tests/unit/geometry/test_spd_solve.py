import numpy as np
import pytest

from sfm_app.errors import NumericalError
from sfm_app.geometry.least_squares import (
    inverse_of_positive,
    inverses_of_positive,
    lift_eigenvalues,
    project_to_psd,
    solve_each,
    solve_positive,
)


@pytest.mark.parametrize("n", [1, 7, 8, 9, 37])
def test_positive_systems_are_solved(n):
    rng = np.random.default_rng(n)
    A = rng.normal(size=(n + 5, n))
    S, B = A.T @ A, rng.normal(size=(n, 3))

    assert S @ solve_positive(S, B) == pytest.approx(B, abs=1e-8)
    inverse = inverse_of_positive(S)
    assert inverse @ S == pytest.approx(np.eye(n), abs=1e-8)
    assert np.array_equal(inverse, inverse.T)


def test_the_arguments_stay_as_they_are():
    S, B = np.diag([1.0, 2.0, 4.0]), np.eye(3)
    solve_positive(S, B)

    assert np.array_equal(S, np.diag([1.0, 2.0, 4.0])) and np.array_equal(B, np.eye(3))


def singular(n, open_directions, seed=0):
    """A matrix in very different units that says nothing along its last eigenvectors, and these."""
    rng = np.random.default_rng(seed)
    basis = np.linalg.qr(rng.normal(size=(n, n)))[0]
    values = np.r_[np.ones(n - open_directions), np.zeros(open_directions)]
    units = 10.0 ** rng.uniform(-6, 6, n)
    return (basis * values) @ basis.T * np.outer(units, units), basis[:, n - open_directions :] / units[:, None]


@pytest.mark.parametrize(("n", "count"), [(3, 1), (8, 2), (20, 1), (37, 5)])
def test_along_what_is_open_a_solution_stays_and_an_inverse_is_wide(n, count):
    S, loose = singular(n, count)
    x = np.random.default_rng(1).normal(size=n) / np.sqrt(np.diag(S))

    found = solve_positive(S, (S @ x)[:, None])[:, 0]
    variances = np.einsum("ji,jk,ki->i", loose, np.linalg.pinv(inverse_of_positive(S)), loose)

    assert S @ found == pytest.approx(S @ x, abs=1e-4 * np.abs(S @ x).max())
    assert np.abs(found * np.sqrt(np.diag(S))).max() < 100 * np.sqrt(n)
    assert np.diag(inverse_of_positive(S)).min() > 0
    assert np.abs(variances).max() < 1e-6, "next to nothing is known along these"


def test_what_is_positive_is_left_as_it_is_and_what_is_not_becomes_so():
    rng = np.random.default_rng(3)
    A = rng.normal(size=(4, 9, 5))
    good, units = np.einsum("pki,pkj->pij", A, A), np.diag([1e-8, 1.0, 1e8, 3.0, 1e-3])
    good = units @ good @ units
    bad = good.copy()
    bad[1] = 0.0
    bad[2] = np.outer(np.arange(5.0), np.arange(5.0))
    bad[3] -= 2.0 * np.diag(np.diag(bad[3]))

    assert lift_eigenvalues(good) is good
    found = lift_eigenvalues(bad)
    assert np.array_equal(found[0], good[0])
    assert np.isfinite(inverses_of_positive(bad)).all()
    assert (np.diagonal(inverses_of_positive(bad), axis1=1, axis2=2) > 0).all()
    assert np.abs(solve_each(bad, np.ones((4, 5, 1)))[1:3]).max() <= 2.0


def test_rounding_leaves_no_less_than_nothing():
    S = np.diag([1.0, -1e-9, 2.0])

    found = project_to_psd(S, np.array([1.0, 1e3, 2.0]))

    assert np.linalg.eigvalsh(found).min() >= 0 and found == pytest.approx(np.diag([1.0, 0.0, 2.0]), abs=1e-15)
    assert project_to_psd(np.diag([1.0, 0.0]), np.ones(2)).tolist() == [[1, 0], [0, 0]]


@pytest.mark.parametrize("bad", [np.nan, np.inf])
@pytest.mark.parametrize("solve", [inverse_of_positive, inverses_of_positive, lambda S: solve_positive(S, np.eye(9))])
def test_what_is_no_number_is_said(bad, solve):
    S = np.eye(9)
    S[4, 4] = bad

    with pytest.raises(NumericalError, match="NaN"):
        solve(S)
