"""Linear systems with positive definite, even nearly singular matrices; no sum depends on LAPACK's threads."""

import numpy as np
from numpy.typing import NDArray

from sfm_app.errors import NumericalError

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

    Along directions that S does not determine, the solution stays near 0.

    Args:
        S: (n, n), symmetric and positive definite up to rounding.
        B: (n, k).

    Raises:
        NumericalError: S has infinite or NaN entries.
    """
    return _eliminate(S, B, PIVOT_FLOOR, 1.0)


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
