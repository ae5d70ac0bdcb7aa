"""Linear systems with positive definite, even nearly singular matrices; no sum depends on LAPACK's threads."""

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from sfm_app.errors import NumericalError

if TYPE_CHECKING:
    from scipy.sparse import csr_array

FloatArray = NDArray[np.float64]

BLOCK = 8
"""Rows that are eliminated at once, without BLAS. Chosen by hand for speed."""
EIGENVALUE_FLOOR = 1e-13
"""Eigenvalues below this, of a matrix scaled to a unit diagonal, are zeros with rounding errors: some hundred sums of
doubles. docs/algorithms.md, Where numbers end."""
PIVOT_FLOOR = 1e-10
"""Share of a pivot that elimination must leave for a solution to move along it: a smaller pivot multiplies the rounding
of all later steps by more than a million. Neither figure was chosen on a set: both follow from the precision of
doubles. docs/algorithms.md, Where numbers end."""

MOST_ELIMINATED = 1500
"""Unknowns up to which systems are solved without LAPACK: the time grows with the cube. Chosen by hand for speed."""
MOST_DENSE, LEAST_DENSE = 12_000, 0.05
"""Unknowns, and share of entries that are not 0, at which a sparse system is solved as a dense one: such systems fill
up in elimination. Chosen by hand for speed and memory."""
RIDGES = (1e-13, 1e-11, 1e-9, 1e-7)
"""Shares by which the diagonal of a large system is raised, one after the other. Not chosen on a set: they follow from
the precision of doubles. docs/algorithms.md, Where numbers end."""

NOT_FINITE = "a matrix has infinite or NaN entries", "this is a bug; please report it with OUT/log.txt"


def lift_eigenvalues(S: FloatArray, least: float = EIGENVALUE_FLOOR, to: float = EIGENVALUE_FLOOR) -> FloatArray:
    """Lift eigenvalues below `least` to `to`; matrices without any are returned unchanged.

    Eigenvalues are those of the matrix scaled to a unit diagonal, so that units do not matter. With `to` = LEAST the
    inverse is nearly infinite along such a direction; with `to` = 1 a solution hardly moves along it.

    Args:
        S: (..., n, n), symmetric.
        least: > 0.
        to: in [least, 1].

    Raises:
        NumericalError: S has infinite or NaN entries.
    """
    if not np.isfinite(S).all():
        raise NumericalError(*NOT_FINITE)
    diagonal = np.einsum("...ii->...i", S)
    scale = np.sqrt(np.where(diagonal > 0.0, diagonal, 1.0))
    pairs = scale[..., :, None] * scale[..., None, :]
    values, vectors = np.linalg.eigh(S / pairs)
    singular = np.any(values < least, axis=-1, keepdims=True)[..., None]
    if not singular.any():
        return S
    raised = np.where(values < least, to, values)
    return np.where(singular, np.einsum("...ik,...k,...jk->...ij", vectors, raised, vectors) * pairs, S)


def solve_positive(S: FloatArray, B: FloatArray) -> FloatArray:
    """Compute S^-1 B by Gauss-Jordan elimination in small blocks, without pivoting.

    Along directions that S does not determine, the solution stays near 0. Large systems are solved by LAPACK, whose
    sums depend on the number of its threads, but not on the workers of a run.

    Args:
        S: (n, n), symmetric and positive definite up to rounding.
        B: (n, k).

    Raises:
        NumericalError: S has infinite or NaN entries.
    """
    return _eliminate(S, B, PIVOT_FLOOR, 1.0) if len(S) <= MOST_ELIMINATED else _solve_by_cholesky(S, B)


def solve_sparse_positive(S: "csr_array", B: FloatArray) -> FloatArray:
    """Compute S^-1 B of a sparse matrix; one with few zeros is solved as a dense one.

    Args:
        S: (n, n), symmetric and positive definite up to rounding.
        B: (n, k).

    Raises:
        NumericalError: S has infinite or NaN entries.
    """
    from scipy import sparse
    from scipy.sparse.linalg import splu

    n = S.shape[0]
    if n <= MOST_ELIMINATED or (n <= MOST_DENSE and S.nnz > LEAST_DENSE * n * n):
        return solve_positive(S.toarray(), B)
    if not np.isfinite(S.data).all():
        raise NumericalError(*NOT_FINITE)
    diagonal = S.diagonal()
    scale = np.where(diagonal > 0.0, diagonal, 1.0) ** -0.5
    balance = sparse.diags_array(scale)
    unit = sparse.csc_array(balance @ S @ balance + RIDGES[0] * sparse.eye_array(n))
    factor = splu(unit, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
    return np.asarray(scale[:, None] * factor.solve(np.ascontiguousarray(scale[:, None] * B)), np.float64)


def _solve_by_cholesky(S: FloatArray, B: FloatArray) -> FloatArray:
    """Compute S^-1 B; where rounding has made S indefinite, the diagonal is raised until it no longer is."""
    from scipy.linalg import cho_factor, cho_solve

    diagonal = np.diag(S)
    scale = np.sqrt(np.where(diagonal > 0.0, diagonal, 1.0))
    unit = S / scale[:, None] / scale
    if not np.isfinite(unit).all():
        raise NumericalError(*NOT_FINITE)
    for raised in RIDGES:
        unit[np.diag_indices(len(unit))] = 1.0 + raised
        try:
            factor = cho_factor(unit, lower=True, check_finite=False)
        except np.linalg.LinAlgError:
            continue
        return np.asarray(cho_solve(factor, B / scale[:, None], check_finite=False) / scale[:, None], np.float64)
    raise NumericalError("a large linear system has no solution", "this is a bug; please report it with OUT/log.txt")


def inverse_of_positive(S: FloatArray) -> FloatArray:
    """Invert a symmetric (n, n), positive definite up to rounding; the inverse is symmetric, with a positive diagonal.

    Raises:
        NumericalError: S has infinite or NaN entries.
    """
    inverse = _eliminate(S, np.eye(len(S)), EIGENVALUE_FLOOR, EIGENVALUE_FLOOR)
    return 0.5 * (inverse + inverse.T)


def inverses_of_positive(S: FloatArray) -> FloatArray:
    """Invert many small positive definite matrices (..., n, n).

    Raises:
        NumericalError: S has infinite or NaN entries.
    """
    return np.asarray(np.linalg.inv(lift_eigenvalues(S)), np.float64)


def solve_each(S: FloatArray, B: FloatArray) -> FloatArray:
    """Compute S^-1 B for many small systems; see `solve_positive`.

    Args:
        S: (..., n, n), symmetric and positive definite up to rounding.
        B: (..., n, k) right-hand sides.
    """
    return np.asarray(np.linalg.solve(lift_eigenvalues(S, PIVOT_FLOOR, 1.0), B), np.float64)


def project_to_psd(S: FloatArray, before: FloatArray) -> FloatArray:
    """Return the nearest positive semidefinite matrix (n, n): eigenvalues that rounding made negative become 0.

    Args:
        S: (n, n), symmetric, left by elimination.
        before: (n,) its diagonal before elimination, which rounding is relative to.
    """
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
    before = np.sqrt(np.where(np.diag(S) > 0.0, np.diag(S), 1.0))
    for start in range(0, n, BLOCK):
        pivot = slice(start, min(start + BLOCK, n))
        rest = np.r_[0:start, pivot.stop : n]
        block = _lift_pivot(M[pivot, pivot], before[pivot], least, to)
        row = np.einsum("ij,jk->ik", np.linalg.inv(block), M[pivot, pivot.stop :])
        M[pivot, pivot.stop :] = row
        M[rest, pivot.stop :] -= np.einsum("ij,jk->ik", M[rest, pivot], row)
    return np.asarray(M[:, n:], np.float64)


def _lift_pivot(block: FloatArray, before: FloatArray, least: float, to: float) -> FloatArray:
    """Lift eigenvalues of which only rounding is left; `before` (n,) is the root of the diagonal before elimination."""
    if not np.isfinite(block).all():
        raise NumericalError(*NOT_FINITE)
    scale = before[:, None] * before
    values, vectors = np.linalg.eigh(block / scale)
    if values[0] >= least:
        return block
    return np.asarray(
        np.einsum("ik,k,jk->ij", vectors, np.where(values < least, to, values), vectors) * scale, np.float64
    )
