"""Matrices of rank 2 as rotations and a singular value: F = U diag(1, s, 0) V' (Bartoli and Sturm 2004).

Three parameters of each rotation and s are seven in all: every step keeps rank 2, and scale is not a parameter. A step
replaces U by U exp([a]x) and V by V exp([b]x).
"""

import numpy as np
from numpy.typing import NDArray

from sfm_app.jit import kernel
from sfm_app.ransac.scoring.robust_costs import FIRST
from sfm_app.ransac.solvers.eigenvalues import decompose_symmetric

FloatArray = NDArray[np.float64]

LEAST_RATIO = 1e-12
"""Least ratio of the first two singular values: below it a matrix counts as rank 1. Rounding in double precision leaves
1e-16; the margin was chosen by hand."""


@kernel
def factorize(F: FloatArray) -> tuple[FloatArray, float, FloatArray]:
    """Decompose the nearest matrix of rank 2, up to scale, into U diag(1, s, 0) V'; return U, s, V."""
    gram, values, vectors = np.zeros((3, 3)), np.empty(3), np.empty((3, 3))
    for i in range(3):
        for j in range(3):
            for k in range(3):
                gram[i, j] += F[k, i] * F[k, j]
    decompose_symmetric(gram, values, vectors)
    U, V = np.empty((3, 3)), np.empty((3, 3))
    for k in range(2):
        for i in range(3):
            V[i, k] = vectors[i, 2 - k]
        for i in range(3):
            U[i, k] = F[i, 0] * V[0, k] + F[i, 1] * V[1, k] + F[i, 2] * V[2, k]
    first = _normalize(U, FIRST)
    _orthogonalize(U)  # removes rounding errors, which matter where s is small
    second = _normalize(U, 1)
    if not second > LEAST_RATIO * first:  # rank 1: any second column will do
        least = 0
        for i in range(1, 3):
            least = i if abs(U[i, 0]) < abs(U[least, 0]) else least
        for i in range(3):
            U[i, 1] = 1.0 if i == least else 0.0
        _orthogonalize(U)
        _normalize(U, 1)
    for i in range(3):  # the third columns, of singular value 0, make both matrices rotations
        j, k = (i + 1) % 3, (i + 2) % 3
        U[i, 2] = U[j, 0] * U[k, 1] - U[k, 0] * U[j, 1]
        V[i, 2] = V[j, 0] * V[k, 1] - V[k, 0] * V[j, 1]
    return U, second / first, V


@kernel
def _normalize(U: FloatArray, k: int) -> float:
    """Divide column k by its length; return the length."""
    length = np.sqrt(U[0, k] * U[0, k] + U[1, k] * U[1, k] + U[2, k] * U[2, k])
    for i in range(3):
        U[i, k] /= length
    return float(length)


@kernel
def _orthogonalize(U: FloatArray) -> None:
    """Make the second column perpendicular to the first, a unit vector."""
    dot = U[0, 0] * U[0, 1] + U[1, 0] * U[1, 1] + U[2, 0] * U[2, 1]
    for i in range(3):
        U[i, 1] -= dot * U[i, 0]


@kernel
def compose(U: FloatArray, s: float, V: FloatArray) -> FloatArray:
    """Return the (9,) entries of U diag(1, s, 0) V' by rows.

    Args:
        U: (3, 3) rotation.
        s: second singular value; the first is 1.
        V: (3, 3) rotation.
    """
    f = np.empty(9)
    for i in range(3):
        for j in range(3):
            f[3 * i + j] = U[i, 0] * V[j, 0] + s * U[i, 1] * V[j, 1]
    return f


@kernel
def fill_tangent_basis(U: FloatArray, s: float, V: FloatArray, basis: FloatArray) -> None:
    """Write the derivatives of F by the seven parameters, one row each: U [e_k]x S V', -U S [e_k]x V', u2 v2'.

    Args:
        U: (3, 3) rotation.
        s: second singular value; the first is 1.
        V: (3, 3) rotation.
        basis: (7, 9), written to.
    """
    for i in range(3):
        for j in range(3):
            k = 3 * i + j
            basis[0, k] = U[i, 2] * s * V[j, 1]
            basis[1, k] = -U[i, 2] * V[j, 0]
            basis[2, k] = U[i, 1] * V[j, 0] - U[i, 0] * s * V[j, 1]
            basis[3, k] = s * U[i, 1] * V[j, 2]
            basis[4, k] = -U[i, 0] * V[j, 2]
            basis[5, k] = U[i, 0] * V[j, 1] - s * U[i, 1] * V[j, 0]
            basis[6, k] = U[i, 1] * V[j, 1]


@kernel
def rotate(R: FloatArray, w: FloatArray) -> FloatArray:
    """Return R exp([w]x) by Rodrigues' formula.

    Args:
        R: (3, 3) rotation.
        w: (3,) rotation vector in radians.
    """
    angle = np.sqrt(w[0] * w[0] + w[1] * w[1] + w[2] * w[2])
    a = np.sin(angle) / angle if angle > 1e-8 else 1.0
    b = (1.0 - np.cos(angle)) / (angle * angle) if angle > 1e-8 else 0.5
    product = np.empty((3, 3))
    for i in range(3):
        # row r of R times exp([w]x) = r - a (w x r) + b w x (w x r), because r [w]x = -(w x r)
        x, y, z = R[i, 0], R[i, 1], R[i, 2]
        cx, cy, cz = w[1] * z - w[2] * y, w[2] * x - w[0] * z, w[0] * y - w[1] * x
        product[i, 0] = x - a * cx + b * (w[1] * cz - w[2] * cy)
        product[i, 1] = y - a * cy + b * (w[2] * cx - w[0] * cz)
        product[i, 2] = z - a * cz + b * (w[0] * cy - w[1] * cx)
    return product
