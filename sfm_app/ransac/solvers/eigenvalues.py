"""Eigenvalues of small symmetric matrices inside kernels, where a call to LAPACK costs more than the work itself.

Jacobi's rotations (Golub and Van Loan 2013, 8.5).
"""

import numpy as np
from numpy.typing import NDArray

from sfm_app.jit import kernel

FloatArray = NDArray[np.float64]

_MOST_SWEEPS = 30
"""Largest number of sweeps over all rotations; convergence is quadratic (Golub and Van Loan 2013). Chosen by hand; not
measured on its own."""
_OFF_DIAGONAL_TOLERANCE = 1e-32
"""Sum of the squared off-diagonal entries over that of the diagonal ones, at convergence: 1e-16, what double precision
leaves, squared."""


@kernel
def decompose_symmetric(matrix: FloatArray, values: FloatArray, vectors: FloatArray) -> None:
    """Write the eigenvalues in ascending order and the unit eigenvectors, by Jacobi's rotations.

    Args:
        matrix: (n, n) symmetric; overwritten.
        values: (n,) filled.
        vectors: (n, n) filled, one eigenvector per column.
    """
    size = matrix.shape[0]
    for i in range(size):
        for j in range(size):
            vectors[i, j] = 1.0 if i == j else 0.0
    for _ in range(_MOST_SWEEPS):
        off, diagonal = 0.0, 0.0
        for i in range(size):
            diagonal += matrix[i, i] * matrix[i, i]
            for j in range(i):
                off += matrix[i, j] * matrix[i, j]
        if not off > _OFF_DIAGONAL_TOLERANCE * diagonal:
            break
        for p in range(size - 1):
            for q in range(p + 1, size):
                if matrix[p, q] != 0.0:
                    _rotate(matrix, vectors, p, q)
    for i in range(size):
        values[i] = matrix[i, i]
    _sort(values, vectors)


@kernel
def _rotate(matrix: FloatArray, vectors: FloatArray, p: int, q: int) -> None:
    """Turn the axes p and q so that entry (p, q) vanishes."""
    cotangent = (matrix[q, q] - matrix[p, p]) / (2.0 * matrix[p, q])
    tangent = 1.0 / (abs(cotangent) + np.sqrt(cotangent * cotangent + 1.0))
    tangent = tangent if cotangent >= 0.0 else -tangent
    c = 1.0 / np.sqrt(tangent * tangent + 1.0)
    s = tangent * c
    for k in range(matrix.shape[0]):
        a, b = matrix[k, p], matrix[k, q]
        matrix[k, p], matrix[k, q] = c * a - s * b, s * a + c * b
    for k in range(matrix.shape[0]):
        a, b = matrix[p, k], matrix[q, k]
        matrix[p, k], matrix[q, k] = c * a - s * b, s * a + c * b
        a, b = vectors[k, p], vectors[k, q]
        vectors[k, p], vectors[k, q] = c * a - s * b, s * a + c * b


@kernel
def _sort(values: FloatArray, vectors: FloatArray) -> None:
    for i in range(values.shape[0] - 1):
        least = i
        for j in range(i + 1, values.shape[0]):
            if values[j] < values[least]:
                least = j
        if least != i:
            values[i], values[least] = values[least], values[i]
            for k in range(values.shape[0]):
                vectors[k, i], vectors[k, least] = vectors[k, least], vectors[k, i]
