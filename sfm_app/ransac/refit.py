"""Non-linear refinement of F on the Sampson distance, over its seven degrees of freedom.

F = U diag(1, s, 0) V' with rotations U and V: three parameters each and s, rank 2 at every step and no spare scale
(Bartoli and Sturm 2004). U turns to U exp([a]x), V to V exp([b]x). Levenberg-Marquardt with reweighted residuals::

    cost = sum_i c^2 log(1 + min(r_i, cutoff)^2 / c^2)          (c = inf: least squares)
"""

import numpy as np
from numpy.typing import NDArray

from sfm_app.jit import kernel
from sfm_app.ransac.leverage import weighted_gram
from sfm_app.ransac.scoring import squared_sampson

FloatArray = NDArray[np.float64]

_SMALLEST_DAMPING, _LARGEST_DAMPING = 1e-12, 1e12
_ENOUGH = 1e-9
"""Relative decrease of the cost under which the search ends."""


def refine_sampson(
    points: FloatArray, F: FloatArray, *, cutoff: float, scale: float = np.inf, most_steps: int = 20
) -> FloatArray:
    """Move F to a local minimum of the robust cost above.

    Args:
        points: (N, 4) matches.
        F: (3, 3) start.
        cutoff: matches farther away than this do not pull.
        scale: Cauchy scale c, in the units of `points`; inf for plain least squares within the cutoff.
        most_steps: most Levenberg-Marquardt steps.

    Returns:
        (3, 3), rank 2, its largest singular value 1.
    """
    U, s, Vt = np.linalg.svd(F)
    U, V = np.ascontiguousarray(U), np.ascontiguousarray(Vt.T)
    U[:, 2] *= np.sign(np.linalg.det(U))  # the third columns meet the singular value 0: their sign is free
    V[:, 2] *= np.sign(np.linalg.det(V))
    return _levenberg_marquardt(points, U, s[1] / s[0], V, cutoff, 1.0 / (scale * scale), most_steps)


def fit_eight_point(points: FloatArray, weights: FloatArray) -> FloatArray:
    """8-point algorithm (thesis 4.3.2) on matches that are well scaled already.

    Args:
        points: (N, 4), of magnitude about 1.
        weights: (N,) >= 0, how much each squared algebraic error counts; at least eight positive ones.

    Returns:
        (3, 3), rank 2.
    """
    _, vectors = np.linalg.eigh(weighted_gram(points, weights))
    U, s, Vt = np.linalg.svd(vectors[:, 0].reshape(3, 3))
    rank_two: FloatArray = (U[:, :2] * s[:2]) @ Vt[:2]
    return rank_two


@kernel
def _levenberg_marquardt(
    points: FloatArray, U: FloatArray, s: float, V: FloatArray, cutoff: float, softness: float, most_steps: int
) -> FloatArray:
    gram, gradient = np.empty((9, 9)), np.empty(9)
    basis, step = np.empty((7, 9)), np.empty(7)
    normal, right = np.empty((7, 7)), np.empty(7)
    f = _compose(U, s, V)
    cost = new_cost = _cost(points, f, cutoff, softness)
    damping = 1e-4
    for _ in range(most_steps):
        _normal_equations(points, f, cutoff, softness, gram, gradient)
        _tangent(U, s, V, basis)
        _project(gram, gradient, basis, normal, right)
        improved = False
        while not improved and damping < _LARGEST_DAMPING:
            if _solve(normal, right, damping, step):
                U_new, V_new, s_new = _turned(U, step[0:3]), _turned(V, step[3:6]), s + step[6]
                new = _compose(U_new, s_new, V_new)
                new_cost = _cost(points, new, cutoff, softness)
                improved = new_cost < cost
            damping = max(damping * 0.1, _SMALLEST_DAMPING) if improved else damping * 10.0
        if not improved:
            break
        done = cost - new_cost <= _ENOUGH * cost
        U, V, s, f, cost = U_new, V_new, s_new, new, new_cost
        if done:
            break
    return f.reshape(3, 3)


@kernel
def _compose(U: FloatArray, s: float, V: FloatArray) -> FloatArray:
    f = np.empty(9)
    for i in range(3):
        for j in range(3):
            f[3 * i + j] = U[i, 0] * V[j, 0] + s * U[i, 1] * V[j, 1]
    return f


@kernel
def _tangent(U: FloatArray, s: float, V: FloatArray, basis: FloatArray) -> None:
    """dF over the seven parameters, one row each: U [e_k]x S V', -U S [e_k]x V', u2 v2'."""
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
def _cost(points: FloatArray, f: FloatArray, cutoff: float, softness: float) -> float:
    limit = cutoff * cutoff
    worst = np.log1p(softness * limit) / softness if softness > 0.0 else limit
    total = 0.0
    for i in range(points.shape[0]):
        squared = squared_sampson(f, points[i, 0], points[i, 1], points[i, 2], points[i, 3])
        if squared < limit:
            total += np.log1p(softness * squared) / softness if softness > 0.0 else squared
        else:
            total += worst
    return total


@kernel
def _normal_equations(
    points: FloatArray, f: FloatArray, cutoff: float, softness: float, gram: FloatArray, gradient: FloatArray
) -> None:
    """Weighted J'J and J'r over the nine entries of F."""
    limit = cutoff * cutoff
    gram[:] = 0.0
    gradient[:] = 0.0
    row = np.empty(9)
    for i in range(points.shape[0]):
        x1, y1, x2, y2 = points[i, 0], points[i, 1], points[i, 2], points[i, 3]
        ax, ay, az = f[0] * x1 + f[1] * y1 + f[2], f[3] * x1 + f[4] * y1 + f[5], f[6] * x1 + f[7] * y1 + f[8]
        bx, by = f[0] * x2 + f[3] * y2 + f[6], f[1] * x2 + f[4] * y2 + f[7]
        algebraic, squared_norm = x2 * ax + y2 * ay + az, ax * ax + ay * ay + bx * bx + by * by
        if not algebraic * algebraic < limit * squared_norm:
            continue
        inverse = 1.0 / np.sqrt(squared_norm)
        residual = algebraic * inverse
        weight = 1.0 / (1.0 + softness * residual * residual)
        # r = n / g with n = x2' F x1 and g the norm: dr = dn / g - r dg / g
        shrink = residual * inverse
        row[0] = (x2 * x1 - shrink * (ax * x1 + bx * x2)) * inverse
        row[1] = (x2 * y1 - shrink * (ax * y1 + by * x2)) * inverse
        row[2] = (x2 - shrink * ax) * inverse
        row[3] = (y2 * x1 - shrink * (ay * x1 + bx * y2)) * inverse
        row[4] = (y2 * y1 - shrink * (ay * y1 + by * y2)) * inverse
        row[5] = (y2 - shrink * ay) * inverse
        row[6] = (x1 - shrink * bx) * inverse
        row[7] = (y1 - shrink * by) * inverse
        row[8] = inverse
        for j in range(9):
            weighted = weight * row[j]
            gradient[j] += weighted * residual
            for k in range(j + 1):
                gram[j, k] += weighted * row[k]
    for j in range(9):
        for k in range(j):
            gram[k, j] = gram[j, k]


@kernel
def _project(gram: FloatArray, gradient: FloatArray, basis: FloatArray, normal: FloatArray, right: FloatArray) -> None:
    """Normal equations over the seven parameters from those over the nine entries."""
    part = np.empty(9)
    for p in range(7):
        right[p] = 0.0
        for j in range(9):
            right[p] -= basis[p, j] * gradient[j]
            part[j] = 0.0
            for k in range(9):
                part[j] += gram[j, k] * basis[p, k]
        for q in range(7):
            normal[p, q] = 0.0
            for j in range(9):
                normal[p, q] += part[j] * basis[q, j]


@kernel
def _solve(normal: FloatArray, right: FloatArray, damping: float, step: FloatArray) -> bool:
    """Cholesky solution of (normal + damping diag(normal)) step = right; False if that is not positive definite."""
    lower = normal.copy()
    largest = 0.0
    for j in range(7):
        largest = max(largest, normal[j, j])
    for j in range(7):
        lower[j, j] += damping * max(normal[j, j], 1e-9 * largest)
    for j in range(7):
        for k in range(j):
            for n in range(k):
                lower[j, k] -= lower[j, n] * lower[k, n]
            lower[j, k] /= lower[k, k]
            lower[j, j] -= lower[j, k] * lower[j, k]
        if not lower[j, j] > 0.0:
            return False
        lower[j, j] = np.sqrt(lower[j, j])
    for j in range(7):
        step[j] = right[j]
        for k in range(j):
            step[j] -= lower[j, k] * step[k]
        step[j] /= lower[j, j]
    for j in range(6, -1, -1):
        for k in range(j + 1, 7):
            step[j] -= lower[k, j] * step[k]
        step[j] /= lower[j, j]
    return True


@kernel
def _turned(R: FloatArray, w: FloatArray) -> FloatArray:
    """R exp([w]x), by Rodrigues."""
    angle = np.sqrt(w[0] * w[0] + w[1] * w[1] + w[2] * w[2])
    a = np.sin(angle) / angle if angle > 1e-8 else 1.0
    b = (1.0 - np.cos(angle)) / (angle * angle) if angle > 1e-8 else 0.5
    turned = np.empty((3, 3))
    for i in range(3):
        # row r of R times exp([w]x) = r - a (w x r) + b w x (w x r), because r [w]x = -(w x r)
        x, y, z = R[i, 0], R[i, 1], R[i, 2]
        cx, cy, cz = w[1] * z - w[2] * y, w[2] * x - w[0] * z, w[0] * y - w[1] * x
        turned[i, 0] = x - a * cx + b * (w[1] * cz - w[2] * cy)
        turned[i, 1] = y - a * cy + b * (w[2] * cx - w[0] * cz)
        turned[i, 2] = z - a * cz + b * (w[0] * cy - w[1] * cx)
    return turned
