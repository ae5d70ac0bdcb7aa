"""Linear systems of positive matrices, also where these are all but singular; no sum depends on LAPACK's threads."""

import numpy as np
from numpy.typing import NDArray

from sfm_app.errors import NumericalError

FloatArray = NDArray[np.float64]

BLOCK = 8
"""Rows that are eliminated at once, without BLAS. Chosen by hand for speed."""
LEAST = 1e-13
"""Eigenvalues below this, of a matrix scaled to a unit diagonal, are what rounding leaves of none: some hundred sums of
doubles. docs/algorithms.md, Where numbers end."""
OPEN = 1e-10
"""What has to be left of a pivot for a solution to move along it: less multiplies the rounding of all that comes after
by more than a million. Neither figure was chosen on a set: both follow from what doubles hold. docs/algorithms.md,
Where numbers end."""

NO_NUMBER = "a matrix holds what is no number", "this is a bug; please report it with OUT/log.txt"


def lifted(S: FloatArray, least: float = LEAST, to: float = LEAST) -> FloatArray:
    """Lift eigenvalues below `least` to `to`; positive matrices stay as they are.

    Eigenvalues are those of the matrix scaled to a unit diagonal, so that units do not matter. Where they become LEAST
    the inverse says that nothing is known along such a direction; where 1, a solution hardly moves along it.

    Args:
        S: (..., n, n), symmetric.
        least: > 0.
        to: in [least, 1].

    Raises:
        NumericalError: it holds what is no number.
    """
    if not np.isfinite(S).all():
        raise NumericalError(*NO_NUMBER)
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
    """Return S^-1 B by Gauss and Jordan's elimination in small blocks, without pivots.

    Along what S does not determine, the answer stays near 0.

    Args:
        S: (n, n), symmetric and positive definite, but for rounding.
        B: (n, k).

    Raises:
        NumericalError: S holds what is no number.
    """
    return _eliminated(S, B, OPEN, 1.0)


def inverse_of_positive(S: FloatArray) -> FloatArray:
    """Return S^-1 of a symmetric (n, n), positive definite but for rounding; symmetric again, with a positive diagonal.

    Raises:
        NumericalError: S holds what is no number.
    """
    inverse = _eliminated(S, np.eye(len(S)), LEAST, LEAST)
    return 0.5 * (inverse + inverse.T)


def inverses_of_positive(S: FloatArray) -> FloatArray:
    """Invert many small positive matrices (..., n, n).

    Raises:
        NumericalError: S holds what is no number.
    """
    return np.asarray(np.linalg.inv(lifted(S)), np.float64)


def solve_each(S: FloatArray, B: FloatArray) -> FloatArray:
    """Return S^-1 B of many small systems; see `solve_positive`.

    Args:
        S: (..., n, n), symmetric, positive but for rounding.
        B: (..., n, k) right-hand sides.
    """
    return np.asarray(np.linalg.solve(lifted(S, OPEN, 1.0), B), np.float64)


def without_negative(S: FloatArray, before: FloatArray) -> FloatArray:
    """Return the nearest S (n, n) that knows nothing along directions where rounding has left less than nothing.

    Args:
        S: what elimination has left.
        before: (n,) the diagonal as it was before: what rounding is relative to.
    """
    scale = np.sqrt(np.where(before > 0.0, before, 1.0))
    pairs = scale[:, None] * scale
    values, vectors = np.linalg.eigh(S / pairs)
    if not values.size or values[0] >= 0.0:
        return S
    return np.asarray(np.einsum("ik,k,jk->ij", vectors, np.maximum(values, 0.0), vectors) * pairs, np.float64)


def _eliminated(S: FloatArray, B: FloatArray, least: float, to: float) -> FloatArray:
    n = len(S)
    M = np.hstack([S, B])
    # how large a pivot was before elimination says when only rounding is left of it
    before = np.sqrt(np.where(np.diag(S) > 0.0, np.diag(S), 1.0))
    for start in range(0, n, BLOCK):
        pivot = slice(start, min(start + BLOCK, n))
        rest = np.r_[0:start, pivot.stop : n]
        block = _pivot(M[pivot, pivot], before[pivot], least, to)
        row = np.einsum("ij,jk->ik", np.linalg.inv(block), M[pivot, pivot.stop :])
        M[pivot, pivot.stop :] = row
        M[rest, pivot.stop :] -= np.einsum("ij,jk->ik", M[rest, pivot], row)
    return np.asarray(M[:, n:], np.float64)


def _pivot(block: FloatArray, before: FloatArray, least: float, to: float) -> FloatArray:
    """Return the block, lifted where elimination has left nothing but rounding of what stood there `before` (n,),
    squared.
    """
    if not np.isfinite(block).all():
        raise NumericalError(*NO_NUMBER)
    scale = before[:, None] * before
    values, vectors = np.linalg.eigh(block / scale)
    if values[0] >= least:
        return block
    return np.asarray(
        np.einsum("ik,k,jk->ij", vectors, np.where(values < least, to, values), vectors) * scale, np.float64
    )
