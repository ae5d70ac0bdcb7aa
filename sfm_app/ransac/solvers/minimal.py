"""Fundamental matrices through seven or eight matches (thesis 4.3.1 and 4.4.2; Hartley and Zisserman, chapter 11)."""

import numpy as np
from numpy.typing import NDArray

from sfm_app.jit import kernel
from sfm_app.ransac.sampling.minimal_samples import SAMPLE_SIZE
from sfm_app.ransac.solvers.design_matrix import design_row

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

MOST_MODELS = 3
"""Real roots of the cubic det F = 0 (thesis 4.3.1)."""
_RANK_TOLERANCE = 1e-9
"""Pivot, relative to the largest, below which the constraints are linearly dependent. Chosen by hand; not measured on
its own."""
_SQUARINGS = 6
"""Squarings of C'C: each doubles the exponent of the ratio of its eigenvalues, to 64. Chosen by hand; not measured on
its own."""


@kernel
def solve_sample(points: FloatArray, sample: IntArray, models: FloatArray) -> int:
    """Compute F from a minimal sample: all solutions through seven matches, or the linear one through eight.

    Seven constraints leave F = a + z b; one more determines z: det F = 0, a cubic with one or three real roots, or an
    eighth match. The linear solution is then replaced by the nearest matrix of rank 2, which with noise no longer fits
    its sample exactly.

    Args:
        points: (N, 4) x1, y1, x2, y2, of magnitude about 1.
        sample: (7,) or (8,) rows of `points`.
        models: (3, 9) filled with the solutions, row by row, each of norm 1.

    Returns:
        Number of solutions, 0 to 3; 0 where the constraints are linearly dependent (repeated or coplanar points).
    """
    basis = np.empty((2, 9))
    if not _null_space(points, sample, basis):
        return 0
    if sample.shape[0] > SAMPLE_SIZE:
        return _solve_eighth_match(points[sample[SAMPLE_SIZE]], basis, models[0])
    return _solve_rank_constraint(basis, models)


@kernel
def _solve_rank_constraint(basis: FloatArray, models: FloatArray) -> int:
    """Write the matrices of the pencil a + z b with determinant 0; return their number."""
    a, b = basis[0], basis[1]
    c0, c1, c2, c3 = _det(a), _mixed_det(a, b), _mixed_det(b, a), _det(b)
    if abs(c3) < abs(c0):  # the larger coefficient leads, so that no root goes to infinity
        a, b = b, a
        c0, c1, c2, c3 = c3, c2, c1, c0
    roots = np.empty(3)
    count = real_cubic_roots(c0, c1, c2, c3, roots)
    for k in range(count):
        z = roots[k]
        norm = np.sqrt(1.0 + z * z)  # a and b are orthonormal
        for j in range(9):
            models[k, j] = (a[j] + z * b[j]) / norm
    return count


@kernel
def _solve_eighth_match(point: FloatArray, basis: FloatArray, model: FloatArray) -> int:
    """Write the F of the pencil that fits `point` (4,), reduced to rank 2 as F - F v v'; return 0 or 1 models."""
    row, v = np.empty(9), np.empty(3)
    design_row(point, row)
    a, b = 0.0, 0.0
    for j in range(9):
        a += basis[0, j] * row[j]
        b += basis[1, j] * row[j]
    for j in range(9):
        model[j] = b * basis[0, j] - a * basis[1, j]
    if not _smallest_singular_vector(model, v):
        return 0
    squared = 0.0
    for i in range(0, 9, 3):
        dot = model[i] * v[0] + model[i + 1] * v[1] + model[i + 2] * v[2]
        for j in range(3):
            model[i + j] -= dot * v[j]
            squared += model[i + j] ** 2
    for j in range(9):
        model[j] /= np.sqrt(squared)
    return 1


@kernel
def _smallest_singular_vector(f: FloatArray, v: FloatArray) -> bool:
    """Write the right singular vector of F's smallest singular value to v (3,); return False for a rank below 2.

    The cofactors C of F have the same singular vectors with the values s2 s3, s1 s3, s1 s2, so that this vector
    dominates C'C, and more strongly after each squaring.
    """
    cofactors, gram, square = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    for i in range(3):
        a, b = 3 * ((i + 1) % 3), 3 * ((i + 2) % 3)
        for j in range(3):
            c, d = (j + 1) % 3, (j + 2) % 3
            cofactors[j, i] = f[a + c] * f[b + d] - f[a + d] * f[b + c]
    for i in range(3):
        for j in range(3):
            gram[i, j] = _dot3(cofactors[i], cofactors[j])
    for _ in range(_SQUARINGS):
        trace = gram[0, 0] + gram[1, 1] + gram[2, 2]
        if not trace > 0.0:
            return False
        for i in range(3):
            for j in range(3):
                square[i, j] = _dot3(gram[i], gram[j]) / (trace * trace)
        gram, square = square, gram
    largest = 0
    for i in range(1, 3):
        if gram[i, i] > gram[largest, largest]:
            largest = i
    norm = np.sqrt(_dot3(gram[largest], gram[largest]))
    for i in range(3):
        v[i] = gram[largest, i] / norm
    return True


@kernel
def _dot3(a: FloatArray, b: FloatArray) -> float:
    return float(a[0] * b[0] + a[1] * b[1] + a[2] * b[2])


@kernel
def is_oriented(points: FloatArray, sample: IntArray, f: FloatArray) -> bool:
    """Return whether the sampled matches can all lie in front of both cameras of f (Chum, Werner and Matas 2004).

    For such points e2 x x2 and F x1 are the same line up to a factor whose sign is the same for all matches.
    Wrong models rarely pass; those that fail need not be scored.

    Args:
        points: (N, 4) matches.
        sample: (m,) rows of `points`.
        f: (9,) entries of F by rows.
    """
    largest = -1.0  # e2 is perpendicular to the columns of F: the most stable cross product of two of them
    e2 = np.empty(3)
    for skipped in range(3):
        j, k = (skipped + 1) % 3, (skipped + 2) % 3
        x = f[3 + j] * f[6 + k] - f[6 + j] * f[3 + k]
        y = f[6 + j] * f[k] - f[j] * f[6 + k]
        z = f[j] * f[3 + k] - f[3 + j] * f[k]
        if x * x + y * y + z * z > largest:
            largest = x * x + y * y + z * z
            e2[0], e2[1], e2[2] = x, y, z
    positive = 0
    for n in range(sample.shape[0]):
        x1, y1, x2, y2 = points[sample[n], 0], points[sample[n], 1], points[sample[n], 2], points[sample[n], 3]
        ax, ay, az = f[0] * x1 + f[1] * y1 + f[2], f[3] * x1 + f[4] * y1 + f[5], f[6] * x1 + f[7] * y1 + f[8]
        side = (e2[1] - e2[2] * y2) * ax + (e2[2] * x2 - e2[0]) * ay + (e2[0] * y2 - e2[1] * x2) * az
        positive += side > 0.0
        if positive != 0 and positive != n + 1:
            return False
    return True


@kernel
def real_cubic_roots(c0: float, c1: float, c2: float, c3: float, roots: FloatArray) -> int:
    """Write the real roots of c0 + c1 z + c2 z^2 + c3 z^3 and return their number: 1 or 3, or 0 if c3 is 0.

    Args:
        c0: constant coefficient.
        c1: coefficient of z.
        c2: coefficient of z^2.
        c3: coefficient of z^3.
        roots: (3,), written to.
    """
    if c3 == 0.0:
        return 0
    a, b, c = c2 / c3, c1 / c3, c0 / c3
    p, q = b - a * a / 3.0, (2.0 * a * a / 27.0 - b / 3.0) * a + c  # t^3 + p t + q = 0 with z = t - a / 3
    discriminant = q * q / 4.0 + p * p * p / 27.0
    count = 1
    if discriminant < 0.0:
        radius = 2.0 * np.sqrt(-p / 3.0)
        angle = np.arccos(min(1.0, max(-1.0, 3.0 * q / (p * radius)))) / 3.0
        for k in range(3):
            roots[k] = radius * np.cos(angle - 2.0 * np.pi * k / 3.0) - a / 3.0
        count = 3
    else:
        # of the two equivalent cube roots, the one without cancellation
        u = np.cbrt(-q / 2.0 - np.sqrt(discriminant)) if q > 0.0 else np.cbrt(-q / 2.0 + np.sqrt(discriminant))
        roots[0] = u - p / (3.0 * u) - a / 3.0 if u != 0.0 else -a / 3.0
    for k in range(count):  # Newton steps remove the rounding errors of the closed form
        for _ in range(2):
            z = roots[k]
            value, slope = ((z + a) * z + b) * z + c, (3.0 * z + 2.0 * a) * z + b
            better = z - value / slope if slope != 0.0 else z
            if abs(((better + a) * better + b) * better + c) < abs(value):  # fails near a multiple root
                roots[k] = better
    return count


@kernel
def _null_space(points: FloatArray, sample: IntArray, basis: FloatArray) -> bool:
    """Write two orthonormal vectors perpendicular to the first seven design rows of the sample, by elimination.

    With complete pivoting it is as exact as Householder reflections, in half the time. Returns False where the rows are
    linearly dependent.
    """
    rows, place = np.empty((SAMPLE_SIZE, 9)), np.empty(9, dtype=np.int64)
    for j in range(9):
        place[j] = j
    for k in range(SAMPLE_SIZE):
        design_row(points[sample[k]], rows[k])
    largest = 0.0
    for k in range(SAMPLE_SIZE):
        pivot = _swap_pivot(rows, place, k)
        largest = max(largest, pivot)
        if not pivot > _RANK_TOLERANCE * largest:
            return False
        for j in range(k + 1, 9):
            rows[k, j] /= rows[k, k]
        for i in range(k + 1, SAMPLE_SIZE):
            for j in range(k + 1, 9):
                rows[i, j] -= rows[i, k] * rows[k, j]
    for n in range(2):
        for j in range(9):
            basis[n, j] = 1.0 if j == place[SAMPLE_SIZE + n] else 0.0
        for k in range(SAMPLE_SIZE - 1, -1, -1):
            behind = rows[k, SAMPLE_SIZE + n]
            for j in range(k + 1, SAMPLE_SIZE):
                behind += rows[k, j] * basis[n, place[j]]
            basis[n, place[k]] = -behind
    _orthonormalize(basis[0], basis[1])
    return True


@kernel
def _swap_pivot(rows: FloatArray, place: IntArray, k: int) -> float:
    """Swap the largest entry from (k, k) on to (k, k); return its magnitude; `place` records the column order."""
    largest, row, column = -1.0, k, k
    for i in range(k, SAMPLE_SIZE):
        for j in range(k, 9):
            if abs(rows[i, j]) > largest:
                largest, row, column = abs(rows[i, j]), i, j
    if row != k:
        for j in range(k, 9):
            rows[row, j], rows[k, j] = rows[k, j], rows[row, j]
    if column != k:
        place[column], place[k] = place[k], place[column]
        for i in range(SAMPLE_SIZE):
            rows[i, column], rows[i, k] = rows[i, k], rows[i, column]
    return largest


@kernel
def _orthonormalize(a: FloatArray, b: FloatArray) -> None:
    length, dot, left = 0.0, 0.0, 0.0
    for j in range(9):
        length += a[j] * a[j]
    for j in range(9):
        a[j] /= np.sqrt(length)
        dot += a[j] * b[j]
    for j in range(9):
        b[j] -= dot * a[j]
        left += b[j] * b[j]
    for j in range(9):
        b[j] /= np.sqrt(left)


@kernel
def _det(m: FloatArray) -> float:
    return _mixed_det(m, m) / 3.0


@kernel
def _mixed_det(m: FloatArray, n: FloatArray) -> float:
    """Return the part of det(m + z n) that is linear in z: the cofactors of m times the entries of n."""
    return float(
        n[0] * (m[4] * m[8] - m[5] * m[7])
        - n[1] * (m[3] * m[8] - m[5] * m[6])
        + n[2] * (m[3] * m[7] - m[4] * m[6])
        - n[3] * (m[1] * m[8] - m[2] * m[7])
        + n[4] * (m[0] * m[8] - m[2] * m[6])
        - n[5] * (m[0] * m[7] - m[1] * m[6])
        + n[6] * (m[1] * m[5] - m[2] * m[4])
        - n[7] * (m[0] * m[5] - m[2] * m[3])
        + n[8] * (m[0] * m[4] - m[1] * m[3])
    )
