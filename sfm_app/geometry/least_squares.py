"""Positive definite, even nearly singular systems, damped steps, and the choice between nested models.

No sum depends on the number of LAPACK's threads, except in large systems. Matrices are symmetric and positive definite
up to rounding; those with infinite or NaN entries raise NumericalError.
"""

from collections.abc import Callable
from dataclasses import dataclass
from itertools import product
from typing import TYPE_CHECKING, NamedTuple, TypeVar

import numpy as np

from sfm_app.errors import NumericalError
from sfm_app.types.arrays import BoolArray, FloatArray

if TYPE_CHECKING:
    from scipy.sparse import csr_array


EIGENVALUE_FLOOR = 1e-13
"""Eigenvalues below this, of a matrix scaled to a unit diagonal, are zeros with rounding errors: some hundred sums of
doubles. docs/algorithms/bundle-adjustment.md."""
PIVOT_FLOOR = 1e-10
"""Share of a pivot that elimination must leave for a solution to move along it: a smaller pivot multiplies the rounding
of later steps by more than a million. It follows from double precision. docs/algorithms/bundle-adjustment.md."""


@dataclass(frozen=True, slots=True)
class SystemOptions:
    """How systems of different size are solved."""

    most_eliminated: int = 100
    """Unknowns up to which systems are solved without LAPACK: the time grows with the cube. By hand, for speed."""
    most_dense: int = 12_000
    """Unknowns up to which a sparse system may be solved as a dense one. Chosen by hand for speed and memory."""
    least_dense: float = 0.05
    """Share of nonzero entries above which it is: such systems fill up in elimination. Chosen by hand for speed."""
    ridges: tuple[float, ...] = (1e-13, 1e-11, 1e-9, 1e-7)
    """Shares by which the diagonal of a large system is raised, one after the other. They follow from double precision.
    docs/algorithms/bundle-adjustment.md."""


OPTIONS = SystemOptions()


NOT_FINITE = "a matrix has infinite or NaN entries", "this is a bug; please report it with OUT/log.txt"


def lift_eigenvalues(
    S: FloatArray, least: float = EIGENVALUE_FLOOR, to: float = EIGENVALUE_FLOOR, scale: FloatArray | None = None
) -> FloatArray:
    """Lift eigenvalues below `least` to `to`, in [least, 1]; matrices (..., n, n) without any are returned unchanged.

    Eigenvalues are those of the matrix scaled to a unit diagonal, so that units do not matter. With `to` = `least` the
    inverse is nearly infinite along such a direction; with `to` = 1 a solution hardly moves along it. `scale` (..., n)
    replaces the roots of the diagonal.
    """
    if not np.isfinite(S).all():
        raise NumericalError(*NOT_FINITE)
    if scale is None:
        scale = _unit_scale(S)
    pairs = scale[..., :, None] * scale[..., None, :]
    try:
        np.linalg.cholesky(S / pairs - least * np.eye(S.shape[-1]))
    except np.linalg.LinAlgError:
        values, vectors = np.linalg.eigh(S / pairs)
    else:  # no eigenvalue is below, and this costs a tenth of computing them
        return S
    # only a matrix with negative eigenvalues has one above its size: what is far below that is rounding
    floor = least * np.maximum(1.0, values[..., -1:] / S.shape[-1])
    singular = np.any(values < floor, axis=-1, keepdims=True)[..., None]
    if not singular.any():
        return S
    raised = np.where(values < floor, np.maximum(to, floor), values)
    return np.where(singular, np.einsum("...ik,...k,...jk->...ij", vectors, raised, vectors) * pairs, S)


def _unit_scale(S: FloatArray) -> FloatArray:
    """Return (..., n) the units in which the diagonal of (..., n, n) is one; 1 where it is not positive."""
    diagonal = np.einsum("...ii->...i", S)
    return np.asarray(np.sqrt(np.where(diagonal > 0.0, diagonal, 1.0)), np.float64)


def solve_positive(S: FloatArray, B: FloatArray, options: SystemOptions = OPTIONS) -> FloatArray:
    """Solve S X = B, (n, k), by Gauss-Jordan elimination in small blocks, without pivoting.

    Along directions that S does not determine, the solution stays near 0. Large systems are solved by LAPACK, whose
    sums depend on the number of its threads, but not on the workers of a run.
    """
    if len(S) <= options.most_eliminated:
        return _eliminate(S, B, PIVOT_FLOOR, 1.0)
    return _solve_by_cholesky(S, B)


def solve_sparse_positive(S: "csr_array", B: FloatArray, options: SystemOptions = OPTIONS) -> FloatArray:
    """Solve S X = B for a sparse matrix; one with few zeros is solved as a dense one."""
    from scipy import sparse
    from scipy.sparse.linalg import splu

    n = S.shape[0]
    if n <= options.most_eliminated or (n <= options.most_dense and S.nnz > options.least_dense * n * n):
        return solve_positive(S.toarray(), B, options)
    if not np.isfinite(S.data).all():
        raise NumericalError(*NOT_FINITE)
    diagonal = S.diagonal()
    scale = np.where(diagonal > 0.0, diagonal, 1.0) ** -0.5
    balance = sparse.diags_array(scale)
    unit = sparse.csc_array(balance @ S @ balance + OPTIONS.ridges[0] * sparse.eye_array(n))
    factor = splu(unit, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
    return np.asarray(scale[:, None] * factor.solve(np.ascontiguousarray(scale[:, None] * B)), np.float64)


def _solve_by_cholesky(S: FloatArray, B: FloatArray) -> FloatArray:
    """Solve S X = B; where rounding has made S indefinite, the diagonal is raised until it no longer is."""
    from scipy.linalg import cho_factor, cho_solve

    scale = _unit_scale(S)
    unit = S / scale[:, None] / scale
    if not np.isfinite(unit).all():
        raise NumericalError(*NOT_FINITE)
    for ridge in OPTIONS.ridges:
        unit[np.diag_indices(len(unit))] = 1.0 + ridge
        try:
            factor = cho_factor(unit, lower=True, check_finite=False)
        except np.linalg.LinAlgError:
            continue
        return np.asarray(cho_solve(factor, B / scale[:, None], check_finite=False) / scale[:, None], np.float64)
    raise NumericalError("a large linear system has no solution", "this is a bug; please report it with OUT/log.txt")


def inverse_of_positive(S: FloatArray) -> FloatArray:
    """Invert a matrix (n, n); the inverse is symmetric, with a positive diagonal."""
    inverse = _eliminate(S, np.eye(len(S)), EIGENVALUE_FLOOR, EIGENVALUE_FLOOR)
    return 0.5 * (inverse + inverse.T)


def inverses_of_positive(S: FloatArray) -> FloatArray:
    """Invert many small matrices (..., n, n), scaled to a unit diagonal, so that units do not matter."""
    if not np.isfinite(S).all():
        raise NumericalError(*NOT_FINITE)
    scale = _unit_scale(S)
    pairs = scale[..., :, None] * scale[..., None, :]
    return np.asarray(np.linalg.inv(lift_eigenvalues(S / pairs)) / pairs, np.float64)


def solve_each(S: FloatArray, B: FloatArray) -> FloatArray:
    """Solve many small systems S X = B, (..., n, n) and (..., n, k), as `solve_positive` does."""
    return np.asarray(np.linalg.solve(lift_eigenvalues(S, PIVOT_FLOOR, 1.0), B), np.float64)


def project_to_psd(S: FloatArray, before: FloatArray) -> FloatArray:
    """Return the nearest positive semidefinite matrix (n, n); `before` (n,) is the diagonal before elimination."""
    scale = np.sqrt(np.where(before > 0.0, before, 1.0))
    pairs = scale[:, None] * scale
    values, vectors = np.linalg.eigh(S / pairs)
    if not values.size or values[0] >= 0.0:
        return S
    return np.asarray(np.einsum("ik,k,jk->ij", vectors, np.maximum(values, 0.0), vectors) * pairs, np.float64)


def _eliminate(S: FloatArray, B: FloatArray, least: float, to: float) -> FloatArray:
    n = len(S)
    M = np.hstack([S, B])
    # a pivot is only rounding if it is tiny relative to its value before elimination
    before = _unit_scale(S)
    for start in range(0, n, 8):  # a few rows at once, without BLAS
        pivot = slice(start, min(start + 8, n))
        rest = np.r_[0:start, pivot.stop : n]
        block = lift_eigenvalues(M[pivot, pivot], least, to, before[pivot])
        row = np.einsum("ij,jk->ik", np.linalg.inv(block), M[pivot, pivot.stop :])
        M[pivot, pivot.stop :] = row
        M[rest, pivot.stop :] -= np.einsum("ij,jk->ik", M[rest, pivot], row)
    return np.asarray(M[:, n:], np.float64)


# Damping of Levenberg-Marquardt steps (Marquardt 1963). The kernels of `fundamental.refits` and
# `posegraph.pair_pose`, and `selfcal.thesis.least_squares` with its simultaneous starts, do the same inside their
# loops.

Trial = TypeVar("Trial")

INCREASE, DECREASE = 10.0, 0.1
"""Factors of the damping after a rejected and after an accepted step. The usual ones (Marquardt 1963)."""


class DampingRange(NamedTuple):
    """Damping relative to the diagonal of the normal equations."""

    first: float
    least: float
    most: float
    """No step is tried with this damping or more."""


def damped_step(
    attempt: Callable[[float], Trial | None], damping: float, limits: DampingRange
) -> tuple[Trial | None, float]:
    """Raise the damping until `attempt` gives a result; return it, or None, and the next damping."""
    while damping < limits.most:
        trial = attempt(damping)
        if trial is not None:
            return trial, max(DECREASE * damping, limits.least)
        damping *= INCREASE
    return None, damping


# Which parameters of a camera are free: models compared by their marginal likelihood (Laplace's approximation, MacKay
# 1992). About the present cameras the negative log-likelihood of a step d is -g'd + d'Hd / 2. Every part of a camera
# (center, aspect, lens) has a narrow prior about its usual value and a wide one; a choice says which of the two each
# part has.


class NormalPriors(NamedTuple):
    """Independent normal priors on n parameters, one row for each of K choices."""

    precision: FloatArray
    """(K, n) 1 / variance, > 0."""
    away: FloatArray
    """(K, n) from the present parameters to the priors' means."""
    log_odds: FloatArray
    """(K,) prior log-probability of each choice."""


class Posteriors(NamedTuple):
    """Posteriors of one likelihood under K choices of priors."""

    log_evidence: FloatArray
    """(K,) log-probability of each choice, up to a constant."""
    steps: FloatArray
    """(K, n) posterior means, as steps from the present parameters."""
    covariances: FloatArray
    """(K, n, n)"""

    def mean_squares(self, about: FloatArray) -> FloatArray:
        """Return (n, n) the second moments about a step (n,) over all choices, each weighted by its probability."""
        odds = np.exp(self.log_evidence - self.log_evidence.max())
        odds /= odds.sum()
        off = self.steps - about
        return np.asarray(
            np.einsum("k,kij->ij", odds, self.covariances) + np.einsum("k,ki,kj->ij", odds, off, off), np.float64
        )


def binary_choices(count: int) -> BoolArray:
    """Return (2^count, count) all choices of free parameters; those that free fewer come first."""
    return np.array(sorted(product((False, True), repeat=count), key=sum), np.bool_)


def cavity(
    covariance: FloatArray, step: FloatArray, precision: FloatArray, away: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return H (n, n) and g (n,), the evidence about a camera without its own prior: posterior less prior."""
    marginal = inverses_of_positive(covariance)
    return marginal - np.diag(precision), marginal @ step - precision * away


def posteriors(H: FloatArray, g: FloatArray, priors: NormalPriors) -> Posteriors:
    """Return the posteriors of K choices, from Hessians (n, n) or (K, n, n) and negative gradients (n,) or (K, n)."""
    precision, away, log_odds = priors
    covariances = inverses_of_positive(H + precision[:, :, None] * np.eye(precision.shape[1]))
    pull = g + precision * away
    value = 0.5 * np.einsum("ki,kij,kj->k", pull, covariances, pull) - 0.5 * np.sum(precision * away**2, axis=1)
    value += 0.5 * np.sum(np.log(precision), axis=1) + 0.5 * np.linalg.slogdet(covariances)[1]
    return Posteriors(value + log_odds, np.einsum("kij,kj->ki", covariances, pull), covariances)
