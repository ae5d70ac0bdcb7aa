"""Linear systems whose answer does not depend on how many threads LAPACK uses."""

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]

BLOCK = 8


def solve_positive(S: FloatArray, B: FloatArray) -> FloatArray:
    """S^-1 B by Gauss and Jordan's elimination in small blocks, without pivots.

    Args:
        S: (n, n), symmetric and positive definite.
        B: (n, k).
    """
    n = len(S)
    M = np.hstack([S, B])
    for start in range(0, n, BLOCK):
        pivot = slice(start, min(start + BLOCK, n))
        rest = np.r_[0:start, pivot.stop : n]
        row = np.einsum("ij,jk->ik", np.linalg.inv(M[pivot, pivot]), M[pivot, pivot.stop :])
        M[pivot, pivot.stop :] = row
        M[rest, pivot.stop :] -= np.einsum("ij,jk->ik", M[rest, pivot], row)
    return np.asarray(M[:, n:], np.float64)


def inverse_of_positive(S: FloatArray) -> FloatArray:
    """S^-1 of a symmetric, positive definite (n, n), symmetric again."""
    inverse = solve_positive(S, np.eye(len(S)))
    return 0.5 * (inverse + inverse.T)
