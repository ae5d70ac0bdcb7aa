"""Positive definite systems, damped steps, nested models."""

import numpy as np
import pytest
from scipy import sparse

from sfm_app.errors import NumericalError
from sfm_app.geometry.least_squares import (
    DampingRange,
    NormalPriors,
    SystemOptions,
    binary_choices,
    cavity,
    damped_step,
    inverse_of_positive,
    inverses_of_positive,
    lift_eigenvalues,
    posteriors,
    project_to_psd,
    solve_each,
    solve_positive,
    solve_sparse_positive,
)


@pytest.mark.parametrize("n", [1, 7, 8, 9, 37])
def test_positive_systems_are_solved_and_the_arguments_stay(n):
    rng = np.random.default_rng(n)
    A = rng.normal(size=(n + 5, n))
    S, B = A.T @ A, rng.normal(size=(n, 3))
    before = S.copy(), B.copy()
    assert S @ solve_positive(S, B) == pytest.approx(B, abs=1e-8)
    inverse = inverse_of_positive(S)
    assert inverse @ S == pytest.approx(np.eye(n), abs=1e-8)
    assert np.array_equal(inverse, inverse.T)
    assert np.array_equal(S, before[0]) and np.array_equal(B, before[1])


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


def test_matrices_that_are_far_from_positive_have_an_inverse():
    v = 1.0 + 0.02 * np.random.default_rng(0).uniform(size=(3000, 5))
    S = 2e14 * v[:, :, None] * v[:, None, :]
    S[:, 0, 0], S[:, 4, 4] = 2.0, 4e40
    assert np.isfinite(inverses_of_positive(S)).all()


def test_rounding_leaves_no_less_than_nothing():
    S = np.diag([1.0, -1e-9, 2.0])
    found = project_to_psd(S, np.array([1.0, 1e3, 2.0]))
    assert np.linalg.eigvalsh(found).min() >= 0 and found == pytest.approx(np.diag([1.0, 0.0, 2.0]), abs=1e-15)
    assert project_to_psd(np.diag([1.0, 0.0]), np.ones(2)).tolist() == [[1, 0], [0, 0]]


@pytest.mark.parametrize("bad", [np.nan, np.inf])
@pytest.mark.parametrize("solve", [inverse_of_positive, inverses_of_positive, lambda S: solve_positive(S, np.eye(9))])
def test_matrices_that_are_not_finite_are_refused(bad, solve):
    S = np.eye(9)
    S[4, 4] = bad
    with pytest.raises(NumericalError, match="NaN"):
        solve(S)


LARGE = SystemOptions(most_eliminated=10, most_dense=10)
"""Takes any system for a large one."""


def system(n, seed=0):
    rng = np.random.default_rng(seed)
    J = rng.normal(size=(3 * n, n)) * 10.0 ** rng.uniform(-4, 4, n)
    return J.T @ J, rng.normal(size=(n, 2))


def test_lapack_and_elimination_agree():
    S, B = system(60)
    small = solve_positive(S, B)
    large = solve_positive(S, B, LARGE)
    np.testing.assert_allclose(large, small, rtol=1e-7)
    assert not np.array_equal(large, small), "they are two ways"


def test_a_large_system_with_an_open_direction_has_a_bounded_solution():
    S, B = system(40)
    S[5] = S[:, 5] = S[6] = S[:, 6] = 0.0
    S[5, 5] = S[6, 6] = S[5, 6] = S[6, 5] = 1.0
    found = solve_positive(S, S @ B, LARGE)
    np.testing.assert_allclose(S @ found, S @ B, rtol=1e-6, atol=1e-6 * np.abs(S @ B).max())


def test_sparse_and_dense_systems_have_the_same_solution():
    rng = np.random.default_rng(0)
    rows = np.repeat(np.arange(300), 4)
    J = sparse.coo_array(
        (rng.normal(size=1200), (rows, rows // 2 + rng.integers(0, 10, 1200))), shape=(300, 160)
    ).tocsr()
    S, B = sparse.csr_array(J.T @ J + 0.01 * sparse.eye_array(160)), rng.normal(size=(160, 3))
    dense = solve_sparse_positive(S, B)

    found = solve_sparse_positive(S, B, LARGE)

    np.testing.assert_allclose(found, dense, rtol=1e-6, atol=1e-9)
    assert S.nnz < 0.3 * 160**2
    for solve in (lambda: solve_sparse_positive(S * np.nan, B), lambda: solve_positive(S.toarray() * np.nan, B, LARGE)):
        with pytest.raises(NumericalError, match="NaN"):
            solve()


LIMITS = DampingRange(first=1e-4, least=1e-9, most=1e3)


def test_a_good_step_is_taken_at_once_and_the_next_is_bolder():
    assert damped_step(lambda damping: damping, 1e-4, LIMITS) == (1e-4, pytest.approx(1e-5))
    assert damped_step(lambda damping: damping, 1e-9, LIMITS) == (1e-9, 1e-9)


def test_damping_grows_tenfold_until_a_step_lowers_the_cost():
    tried = []
    step, damping = damped_step(
        lambda damping: tried.append(damping) or (damping if damping > 0.5 else None), 1e-2, LIMITS
    )
    np.testing.assert_allclose([step, damping, *tried], [1.0, 0.1, 1e-2, 0.1, 1.0])
    step, damping = damped_step(lambda _: None, 1.0, LIMITS)
    assert step is None and damping >= LIMITS.most


H, G = np.array([[40.0]]), np.array([12.0])
PRIORS = NormalPriors(np.array([[100.0], [4.0]]), np.array([[0.1], [0.1]]), np.log([0.7, 0.3]))


def test_the_evidence_is_the_integral():
    d = np.linspace(-3.0, 3.0, 60001)
    integrals = [
        np.log(odds) + np.log(np.sum(np.exp(G[0] * d - 0.5 * H[0, 0] * d**2) * belief) * (d[1] - d[0]))
        for odds, belief in zip(
            (0.7, 0.3),
            (np.sqrt(p / (2 * np.pi)) * np.exp(-0.5 * p * (d - 0.1) ** 2) for p in (100.0, 4.0)),
            strict=True,
        )
    ]
    found = posteriors(H, G, PRIORS).log_evidence
    assert found[1] - found[0] == pytest.approx(integrals[1] - integrals[0], abs=1e-6)
    assert abs(found[1] - found[0]) > 0.05


def test_the_mean_squares_are_those_of_the_mixture():
    found = posteriors(H, G, PRIORS)
    odds = np.exp(found.log_evidence) / np.exp(found.log_evidence).sum()
    expected = sum(
        o * (c[0, 0] + (s[0] - 0.2) ** 2) for o, c, s in zip(odds, found.covariances, found.steps, strict=True)
    )
    assert found.mean_squares(np.array([0.2]))[0, 0] == pytest.approx(expected)


def test_the_cavity_takes_the_prior_out_again():
    precision, away = np.array([9.0, 25.0]), np.array([0.3, -0.2])
    likelihood, gradient = np.array([[50.0, 10.0], [10.0, 30.0]]), np.array([1.0, -2.0])
    covariance = np.linalg.inv(likelihood + np.diag(precision))
    back = cavity(covariance, covariance @ (gradient + precision * away), precision, away)
    np.testing.assert_allclose(back[0], likelihood)
    np.testing.assert_allclose(back[1], gradient)


def test_choices_that_free_less_come_first():
    assert binary_choices(2).tolist() == [[False, False], [False, True], [True, False], [True, True]]
