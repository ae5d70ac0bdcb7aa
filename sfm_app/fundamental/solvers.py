"""Solvers of minimal and larger samples (thesis, section 4.2)."""

from itertools import product

import numpy as np

from sfm_app.fundamental.samples import SAMPLE_SIZE
from sfm_app.fundamental.scores import FIRST
from sfm_app.jit import kernel, summing_kernel
from sfm_app.types.arrays import FloatArray, IndexArray

# Design matrix A of the matches, row by row x2 (x) x1 (thesis 2.27): x2' F x1 = 0 is A f = 0. Sums over matches run
# in blocks that fit in the first-level cache, each quantity contiguous, so that they are vectorized.

LANES = 64
"""Matches in a block; with the rows of A they take 7 kB. Chosen by hand for speed."""


@kernel
def design_row(point: FloatArray, row: FloatArray) -> None:
    """Write x2 (x) x1 (9,), the coefficients of the entries of F in x2' F x1 = 0, for one match (4,)."""
    for i in range(3):
        factor = point[2 + i] if i < 2 else 1.0
        row[3 * i] = factor * point[0]
        row[3 * i + 1] = factor * point[1]
        row[3 * i + 2] = factor


@kernel
def gather(points: FloatArray, weights: FloatArray, start: int, block: FloatArray) -> tuple[int, int]:
    """Copy the next matches of weight > 0, and its root, to `block` (5, LANES); return their number, the next row."""
    filled, i = 0, start
    while i < points.shape[0] and filled < LANES:
        if weights[i] > 0.0:
            for k in range(4):
                block[k, filled] = points[i, k]
            block[4, filled] = np.sqrt(weights[i])
            filled += 1
        i += 1
    return filled, i


@kernel
def _design_columns(block: FloatArray, count: int, rows: FloatArray) -> None:
    """Write the rows of A for the matches of a block (see `gather`), times sqrt(weight), as columns (9, LANES)."""
    for n in range(count):
        x1, y1, x2, y2, root = block[0, n], block[1, n], block[2, n], block[3, n], block[4, n]
        rows[0, n], rows[1, n], rows[2, n] = x2 * x1 * root, x2 * y1 * root, x2 * root
        rows[3, n], rows[4, n], rows[5, n] = y2 * x1 * root, y2 * y1 * root, y2 * root
        rows[6, n], rows[7, n], rows[8, n] = x1 * root, y1 * root, root


@summing_kernel
def add_products(rows: FloatArray, count: int, gram: FloatArray) -> None:
    """Add the sums over the first `count` columns of rows[j] rows[k] to gram[j, k] for all k <= j."""
    for j in range(rows.shape[0]):
        for k in range(j + 1):
            total = 0.0
            for n in range(count):
                total += rows[j, n] * rows[k, n]
            gram[j, k] += total


@kernel
def mirror(gram: FloatArray) -> None:
    """Copy the lower triangle to the upper one."""
    for j in range(gram.shape[0]):
        for k in range(j):
            gram[k, j] = gram[j, k]


def weighted_gram(points: FloatArray, weights: FloatArray) -> FloatArray:
    """Return the (9, 9) matrix A' W A for weights (N,) >= 0."""
    gram = np.zeros((9, 9))
    _add_gram(points, weights, gram)
    return gram


@kernel
def _add_gram(points: FloatArray, weights: FloatArray, gram: FloatArray) -> None:
    # gram.shape[0] instead of 9: if the size were known at compile time, the compiler would unroll all 45 sums
    block, rows = np.empty((5, LANES)), np.empty((gram.shape[0], LANES))
    start = FIRST
    while start < points.shape[0]:
        count, start = gather(points, weights, start, block)
        _design_columns(block, count, rows)
        add_products(rows, count, gram)
    mirror(gram)


@kernel
def quadratic_forms(points: FloatArray, whitening: FloatArray) -> FloatArray:
    """Return (N,) squared lengths of the rows of A times `whitening` (9, p)."""
    count = points.shape[0]
    forms, ones = np.zeros(count), np.ones(count)
    block, rows, dots = np.empty((5, LANES)), np.empty((9, LANES)), np.empty(LANES)
    start = FIRST
    while start < count:
        first = start
        filled, start = gather(points, ones, start, block)
        _design_columns(block, filled, rows)
        for k in range(whitening.shape[1]):
            for n in range(filled):
                dots[n] = 0.0
            for j in range(9):
                factor = whitening[j, k]
                for n in range(filled):
                    dots[n] += factor * rows[j, n]
            for n in range(filled):
                forms[first + n] += dots[n] * dots[n]
    return forms


# Eigenvalues by Jacobi's rotations (Golub and Van Loan 2013, 8.5): in kernels a call to LAPACK costs more than the
# work.


@kernel
def decompose_symmetric(matrix: FloatArray, values: FloatArray, vectors: FloatArray) -> None:
    """Write the ascending eigenvalues (n,) and the unit eigenvectors, one per column; overwrite `matrix`."""
    size = matrix.shape[0]
    vectors[:] = np.eye(size)
    for _ in range(30):  # convergence is quadratic
        off, diagonal = 0.0, 0.0
        for i in range(size):
            diagonal += matrix[i, i] * matrix[i, i]
            for j in range(i):
                off += matrix[i, j] * matrix[i, j]
        if not off > 1e-32 * diagonal:  # rounding in double precision, squared
            break
        for p in range(size - 1):
            for q in range(p + 1, size):
                if matrix[p, q] != 0.0:
                    _rotate(matrix, vectors, p, q)
    order = np.argsort(np.diag(matrix))
    values[:] = np.diag(matrix)[order]
    vectors[:] = vectors[:, order]


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


# Fundamental matrices through seven or eight matches (thesis 4.3.1 and 4.4.2; Hartley and Zisserman, chapter 11).

MOST_MODELS = 3
"""Real roots of the cubic det F = 0 (thesis 4.3.1)."""


@kernel
def solve_sample(points: FloatArray, sample: IndexArray, models: FloatArray) -> int:
    """Write all F of norm 1 through seven matches, or the linear F of eight, to `models` (3, 9); return how many.

    Seven constraints leave F = a + z b. One more determines z: det F = 0, a cubic with one or three real roots, or an
    eighth match. The linear solution is then replaced by the nearest matrix of rank 2, which with noise no longer fits
    its sample exactly. The number is 0 where the constraints are linearly dependent (repeated or coplanar points).
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
    model /= np.sqrt(squared)
    return 1


@kernel
def _smallest_singular_vector(f: FloatArray, v: FloatArray) -> bool:
    """Write the right singular vector of F's smallest singular value to v (3,); return False for a rank below 2.

    The cofactors C of F have the same singular vectors with the values s2 s3, s1 s3, s1 s2: this vector dominates C'C,
    and more strongly after each squaring.
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
    for _ in range(6):  # each squaring doubles the exponent of the ratio of eigenvalues, to 64
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
def is_oriented(points: FloatArray, sample: IndexArray, f: FloatArray) -> bool:
    """Return whether the sampled matches can all lie in front of both cameras of f (Chum, Werner and Matas 2004).

    For such points e2 x x2 and F x1 are the same line up to a factor whose sign is the same for all matches. Wrong
    models rarely pass.
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
    """Write the real roots of c0 + c1 z + c2 z^2 + c3 z^3 to `roots` (3,); return their number; 0 if c3 is 0."""
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
def _null_space(points: FloatArray, sample: IndexArray, basis: FloatArray) -> bool:
    """Write two orthonormal vectors perpendicular to the first seven design rows; False if these are dependent."""
    rows, place = np.empty((SAMPLE_SIZE, 9)), np.arange(9)
    for k in range(SAMPLE_SIZE):
        design_row(points[sample[k]], rows[k])
    largest = 0.0
    for k in range(SAMPLE_SIZE):
        pivot = _swap_pivot(rows, place, k)
        largest = max(largest, pivot)
        if not pivot > 1e-9 * largest:
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
            pending = rows[k, SAMPLE_SIZE + n]
            for j in range(k + 1, SAMPLE_SIZE):
                pending += rows[k, j] * basis[n, place[j]]
            basis[n, place[k]] = -pending
    _orthonormalize(basis[0], basis[1])
    return True


@kernel
def _swap_pivot(rows: FloatArray, place: IndexArray, k: int) -> float:
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
    length, dot, rest = 0.0, 0.0, 0.0
    for j in range(9):
        length += a[j] * a[j]
    for j in range(9):
        a[j] /= np.sqrt(length)
        dot += a[j] * b[j]
    for j in range(9):
        b[j] -= dot * a[j]
        rest += b[j] * b[j]
    for j in range(9):
        b[j] /= np.sqrt(rest)


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


# Essential matrices from five rays and their partners (Nistér 2004). The ten cubic equations 2 E E'E = tr(E E') E and
# det E = 0 in the coordinates of the null space are solved by an action matrix (Stewénius, Engels and Nistér 2006);
# derived here from the products of linear forms.

RAY_SAMPLE_SIZE = 5
"""Matches of a sample: E has five degrees of freedom. Counted."""
_MONOMIALS = (
    "xxx", "xxy", "xxz", "xyy", "xyz", "xzz", "yyy", "yyz", "yzz", "zzz",
    "xx1", "xy1", "xz1", "yy1", "yz1", "zz1", "x11", "y11", "z11", "111",
)  # fmt: skip
"""Products of three of x, y, z and 1: cubic monomials, then the basis of the quotient ring."""
_PLACES = {"".join(sorted(name)): place for place, name in enumerate(_MONOMIALS)}
_SUM = np.zeros((64, 20))
"""From products of three letters to monomials. By definition."""
for _row, _letters in enumerate(product("xyz1", repeat=3)):
    _SUM[_row, _PLACES["".join(sorted(_letters))]] = 1.0
_LEVI_CIVITA = np.zeros((3, 3, 3))
"""Signs of permutations. By definition."""
for _i, _j, _k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
    _LEVI_CIVITA[_i, _j, _k], _LEVI_CIVITA[_i, _k, _j] = 1.0, -1.0


def solve_five_point(p: FloatArray, q: FloatArray) -> FloatArray:
    """Return (M, 3, 3) essential matrices of norm 1 through samples of five rays p and q (S, 5, 3)."""
    rows = (q[..., :, None] * p[..., None, :]).reshape(len(p), RAY_SAMPLE_SIZE, 9)
    null = np.linalg.svd(rows)[2][:, RAY_SAMPLE_SIZE:].reshape(-1, 4, 3, 3)
    E = np.ascontiguousarray(null.transpose(0, 2, 3, 1))  # (S, 3, 3, 4): linear forms in x, y, z, 1
    products = np.einsum("sika,sjkb->sijab", E, E)
    cubes = 2.0 * np.einsum("sijab,sjkc->sikabc", products, E)
    cubes -= np.einsum("sab,sikc->sikabc", np.einsum("siiab->sab", products), E)
    determinant = np.einsum("ijk,sia,sjb,skc->sabc", _LEVI_CIVITA, E[:, 0], E[:, 1], E[:, 2], optimize=True)
    equations = np.concatenate([cubes.reshape(len(p), 9, 64), determinant.reshape(len(p), 1, 64)], 1) @ _SUM
    regular = np.abs(np.linalg.det(equations[:, :, :10])) > 1e-300
    equations, null = equations[regular], null[regular]
    if not len(null):
        return np.zeros((0, 3, 3))
    reduced = -np.linalg.solve(equations[:, :, :10], equations[:, :, 10:])
    action = np.zeros((len(null), 10, 10))
    action[:, :6] = reduced[:, :6]  # x times xx, xy, xz, yy, yz, zz
    action[:, [6, 7, 8, 9], [0, 1, 2, 6]] = 1.0  # x times x, y, z, 1
    if not np.isfinite(action).all():
        action = np.nan_to_num(action, nan=0.0, posinf=0.0, neginf=0.0)
    values, vectors = np.linalg.eig(action)
    last = vectors[:, 9]
    real = (np.abs(values.imag) <= 1e-6 * (1.0 + np.abs(values))) & (np.abs(last) > 1e-12)
    sample, root = np.nonzero(real)
    roots = (vectors[sample, 6:9, root] / vectors[sample, 9, root][:, None]).real
    models = np.einsum("na,naij->nij", np.column_stack([roots, np.ones(len(roots))]), null[sample])
    lengths = np.linalg.norm(models, axis=(1, 2))
    valid = np.isfinite(lengths) & (lengths > 0.0)
    return np.asarray(models[valid] / lengths[valid, None, None], np.float64)
