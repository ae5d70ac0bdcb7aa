"""Fits to all inliers: rank two, Sampson distance, Gold Standard (thesis, chapter 4)."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from sfm_app.fundamental.leverage import mad_sigma
from sfm_app.fundamental.scores import FIRST, fill_squared_distances, squared_distances
from sfm_app.fundamental.solvers import LANES, add_products, decompose_symmetric, gather, mirror, weighted_gram
from sfm_app.geometry.epipolar import nearest_exact_matches, nearest_rank_two, to_homogeneous, to_unit_norm
from sfm_app.geometry.least_squares import DampingRange, damped_step
from sfm_app.jit import kernel, summing_kernel
from sfm_app.types.arrays import FloatArray

# Matrices of rank 2 as rotations and a singular value: F = U diag(1, s, 0) V' (Bartoli and Sturm 2004). Three
# parameters of each rotation and s are seven: every step keeps rank 2, and scale is no parameter. A step replaces U
# by U exp([a]x) and V by V exp([b]x).


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
        V[:, k] = vectors[:, 2 - k]
        for i in range(3):
            U[i, k] = F[i, 0] * V[0, k] + F[i, 1] * V[1, k] + F[i, 2] * V[2, k]
    first = _normalize(U, FIRST)
    _orthogonalize(U)  # removes rounding errors, which matter where s is small
    second = _normalize(U, 1)
    if not second > 1e-12 * first:  # rank 1 but for rounding: any second column will do
        U[:, 1] = 0.0
        U[np.argmin(np.abs(U[:, 0])), 1] = 1.0
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
    U[:, k] /= length
    return float(length)


@kernel
def _orthogonalize(U: FloatArray) -> None:
    dot = U[0, 0] * U[0, 1] + U[1, 0] * U[1, 1] + U[2, 0] * U[2, 1]
    U[:, 1] -= dot * U[:, 0]


@kernel
def compose(U: FloatArray, s: float, V: FloatArray) -> FloatArray:
    """Return the (9,) entries of U diag(1, s, 0) V' by rows."""
    f = np.empty(9)
    for i in range(3):
        for j in range(3):
            f[3 * i + j] = U[i, 0] * V[j, 0] + s * U[i, 1] * V[j, 1]
    return f


@kernel
def fill_tangent_basis(U: FloatArray, s: float, V: FloatArray, basis: FloatArray) -> None:
    """Write the derivatives (7, 9) of F by the parameters: U [e_k]x S V', -U S [e_k]x V', u2 v2'."""
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
    """Return R exp([w]x) by Rodrigues' formula; w (3,) in radians."""
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


# Refinement on the Sampson distance (thesis 4.3, Eq. 4.2) by iteratively reweighted least squares: weigh the matches
# by their distances, take one Levenberg-Marquardt step that lowers sum_i w_i r_i^2, weigh again. For a cost that is a
# concave function of r^2, as robust costs are, such a step lowers the cost itself as well.

_COST_TOLERANCE = 1e-9
"""Relative decrease of the cost that ends least squares. Chosen by hand; not measured on its own."""
_NEGLIGIBLE = 1e-3
"""Weight below which a match is left out of a step. Chosen by hand; not measured on its own."""


class Weighting(NamedTuple):
    """Weights of squared distances: by a robust cost, or by a mixture of two densities."""

    is_mixture: bool = False
    softness: float = 0.0
    """Robust cost: 1 / c^2 of r^2 / (1 + r^2 / c^2); 0 for least squares."""
    squared_reach: float = 0.0
    """Mixture: squared distance within which matches count; outliers are uniform up to this distance."""
    largest_variance: float = 0.0
    """Mixture: upper bound of the inliers' variance."""
    first_variance: float = 0.0
    """Mixture: initial variance in expectation maximization."""


def refine_sampson(
    points: FloatArray,
    F: FloatArray,
    *,
    scale: float = np.inf,
    most_steps: int = 20,
    tolerance: float = _COST_TOLERANCE,
) -> FloatArray:
    """Minimize sum_i r_i^2 / (1 + r_i^2 / c^2), c = `scale` (Geman and McClure 1987); rank 2, s1 = 1."""
    weighing = Weighting(softness=float(scale**-2))
    return _reweighted_least_squares(points, *factorize(F), weighing, most_steps, tolerance, np.empty((10, 10)))


def refine_mixture(points: FloatArray, F: FloatArray, threshold: float, *, reach: float, most_steps: int) -> FloatArray:
    """Estimate F with the sigma and share of inliers by maximum likelihood: EM (thesis 3.5 and 4.6).

    Among the matches within `reach` > 1 thresholds, signed distances of inliers are Gaussian about 0, with a sigma of
    at most one threshold, those of outliers uniform. The weight of a match is the probability that it is an inlier. F
    must be near enough for its inliers to determine sigma. It gets rank 2 and the largest singular value 1.
    """
    U, s, V = factorize(F)
    squared = squared_distances(points, compose(U, s, V))
    inliers = squared[squared <= threshold * threshold]
    sigma = mad_sigma(np.sqrt(inliers)) if len(inliers) else threshold
    squared_reach = float((reach * threshold) ** 2)
    weighing = Weighting(
        is_mixture=squared_reach > 0.0,  # where the squared threshold underflows, fall back to least squares
        squared_reach=squared_reach,
        largest_variance=float(threshold**2),
        first_variance=float(min(sigma, threshold) ** 2),
    )
    return _reweighted_least_squares(points, U, s, V, weighing, most_steps, 1e-4, np.empty((10, 10)))


def fit_eight_point(points: FloatArray, weights: FloatArray) -> FloatArray:
    """Apply the 8-point algorithm (thesis 4.3.2) with weights (N,) >= 0, eight of them > 0; (3, 3) of rank 2."""
    U, s, V = factorize(fit_algebraic(points, weights))
    return compose(U, s, V).reshape(3, 3)


def fit_algebraic(points: FloatArray, weights: FloatArray) -> FloatArray:
    """Return the (3, 3) matrix of norm 1 and any rank with the least algebraic error, weighted by (N,)."""
    _, vectors = np.linalg.eigh(weighted_gram(points, weights))
    return np.ascontiguousarray(vectors[:, 0]).reshape(3, 3)


@kernel
def _reweighted_least_squares(  # noqa: PLR0913
    points: FloatArray, U: FloatArray, s: float, V: FloatArray, weighing: Weighting, most_steps: int, tolerance: float,
    gram: FloatArray,
) -> FloatArray:  # fmt: skip
    """Weigh and step in turn until a step lowers the cost by less than the relative decrease `tolerance`.

    `gram` (10, 10) is a work array: if its size were known at compile time, the compiler would unroll all sums.
    """
    count = points.shape[0]
    weights, squared, trial = np.empty(count), np.empty(count), np.empty(count)
    normal, right, step = np.empty((7, 7)), np.empty(7), np.empty(7)
    f = compose(U, s, V)
    fill_squared_distances(points, f, FIRST, squared)
    damping, variance, share = 1e-4, weighing.first_variance, 0.9
    for n in range(most_steps):
        if weighing.is_mixture:
            rounds = 6 if n == 0 else 1
            variance, share = _weigh_by_mixture(squared, weighing, variance, share, rounds, weights)
        else:
            _weigh_robustly(squared, weighing.softness, weights)
        cost = new_cost = _weighted_sum(squared, weights)
        _normal_equations(points, f, weights, U, s, V, gram, normal, right)
        improved = False
        while not improved and damping < 1e12:
            if _solve_damped(normal, right, damping, step):
                U_new, V_new, s_new = rotate(U, step[0:3]), rotate(V, step[3:6]), s + step[6]
                new = compose(U_new, s_new, V_new)
                fill_squared_distances(points, new, FIRST, trial)
                new_cost = _weighted_sum(trial, weights)
                improved = new_cost < cost
            damping = max(damping * 0.1, 1e-12) if improved else damping * 10.0
        if not improved:
            break
        U, V, s, f = U_new, V_new, s_new, new
        squared, trial = trial, squared
        if cost - new_cost <= tolerance * cost:
            break
    return f.reshape(3, 3)


@kernel
def _weigh_robustly(squared: FloatArray, softness: float, weights: FloatArray) -> None:
    """Weigh matches by d/d(r^2) of r^2 / (1 + softness r^2)."""
    for i in range(squared.shape[0]):
        root = 1.0 / (1.0 + softness * squared[i])
        weights[i] = root * root if root * root > _NEGLIGIBLE else 0.0


@kernel
def _weigh_by_mixture(
    squared: FloatArray, weighing: Weighting, variance: float, share: float, rounds: int, weights: FloatArray
) -> tuple[float, float]:
    """Weigh matches by their probability to be inliers; return the new variance and share of inliers."""
    reach, largest = weighing.squared_reach, weighing.largest_variance
    for _ in range(rounds):
        inlier, outlier = share * np.sqrt(2.0 / (np.pi * variance)), (1.0 - share) / np.sqrt(reach)
        near, total, moment = 0, 0.0, 0.0
        for i in range(squared.shape[0]):
            weights[i] = 0.0
            if squared[i] < reach:
                near += 1
                density = inlier * np.exp(-squared[i] / (2.0 * variance))
                weight = density / (density + outlier)
                total += weight
                moment += weight * squared[i]
                weights[i] = weight if weight > _NEGLIGIBLE else 0.0
        variance = moment / max(total - 7.0, 1.0)  # seven parameters of F are fitted to the same matches
        # sigma within 0.02 to 1 thresholds: without a bound nearly perfect matches would exclude all others
        variance = min(max(variance, 0.02 * 0.02 * largest), largest)
        share = min(max(total / max(near, 1), 1.0 - 0.999), 0.999)
    return variance, share


@summing_kernel
def _weighted_sum(squared: FloatArray, weights: FloatArray) -> float:
    total = 0.0
    for i in range(squared.shape[0]):
        total += weights[i] * squared[i] if weights[i] > 0.0 else 0.0
    return total


@kernel
def _normal_equations(  # noqa: PLR0913
    points: FloatArray, f: FloatArray, weights: FloatArray, U: FloatArray, s: float, V: FloatArray,
    gram: FloatArray, normal: FloatArray, right: FloatArray,
) -> None:  # fmt: skip
    """Write the weighted J'J and -J'r of the seven parameters to `normal` and `right`."""
    gram[:] = 0.0
    block, rows = np.empty((5, LANES)), np.empty((gram.shape[0], LANES))
    start = FIRST
    while start < points.shape[0]:
        count, start = gather(points, weights, start, block)
        _derivatives(block, count, f, rows)
        add_products(rows, count, gram)
    mirror(gram)
    basis = np.empty((7, 9))
    fill_tangent_basis(U, s, V, basis)
    _project(gram, basis, normal, right)


@kernel
def _derivatives(block: FloatArray, count: int, f: FloatArray, rows: FloatArray) -> None:
    """Write sqrt(weight) times dr / dF (9 rows) and r (the last): r = n / g, dr = dn / g - r dg / g, n = x2' F x1."""
    f0, f1, f2, f3, f4, f5, f6, f7, f8 = f[0], f[1], f[2], f[3], f[4], f[5], f[6], f[7], f[8]
    for n in range(count):
        x1, y1, x2, y2 = block[0, n], block[1, n], block[2, n], block[3, n]
        ax, ay, az = f0 * x1 + f1 * y1 + f2, f3 * x1 + f4 * y1 + f5, f6 * x1 + f7 * y1 + f8
        bx, by = f0 * x2 + f3 * y2 + f6, f1 * x2 + f4 * y2 + f7
        inverse = 1.0 / np.sqrt(ax * ax + ay * ay + bx * bx + by * by)
        residual = (x2 * ax + y2 * ay + az) * inverse
        shrink, scale = residual * inverse, inverse * block[4, n]
        rows[0, n] = (x2 * x1 - shrink * (ax * x1 + bx * x2)) * scale
        rows[1, n] = (x2 * y1 - shrink * (ax * y1 + by * x2)) * scale
        rows[2, n] = (x2 - shrink * ax) * scale
        rows[3, n] = (y2 * x1 - shrink * (ay * x1 + bx * y2)) * scale
        rows[4, n] = (y2 * y1 - shrink * (ay * y1 + by * y2)) * scale
        rows[5, n] = (y2 - shrink * ay) * scale
        rows[6, n] = (x1 - shrink * bx) * scale
        rows[7, n] = (y1 - shrink * by) * scale
        rows[8, n] = scale
        rows[9, n] = residual * block[4, n]


@kernel
def _project(gram: FloatArray, basis: FloatArray, normal: FloatArray, right: FloatArray) -> None:
    """Project the normal equations of the nine entries (last row: the gradient) to the seven parameters."""
    part = np.empty(9)
    for p in range(7):
        right[p] = 0.0
        for j in range(9):
            right[p] -= basis[p, j] * gram[9, j]
            part[j] = 0.0
            for k in range(9):
                part[j] += gram[j, k] * basis[p, k]
        for q in range(7):
            normal[p, q] = 0.0
            for j in range(9):
                normal[p, q] += part[j] * basis[q, j]


@kernel
def _solve_damped(normal: FloatArray, right: FloatArray, damping: float, step: FloatArray) -> bool:
    """Write the solution of (normal + damping diag(normal)) step = right; False if not positive definite."""
    lower, largest = normal.copy(), np.max(np.diag(normal))
    for j in range(7):
        lower[j, j] += damping * max(normal[j, j], 1e-9 * largest)  # matches may leave a direction of F free
    return solve_cholesky(lower, right, step)


@kernel
def solve_cholesky(lower: FloatArray, right: FloatArray, step: FloatArray) -> bool:
    """Write x of A x = right to `step` (n,); `lower` (n, n), A, is overwritten. False if A is not positive definite."""
    size = right.shape[0]
    for j in range(size):
        for k in range(j):
            for n in range(k):
                lower[j, k] -= lower[j, n] * lower[k, n]
            lower[j, k] /= lower[k, k]
            lower[j, j] -= lower[j, k] * lower[j, k]
        if not lower[j, j] > 0.0:
            return False
        lower[j, j] = np.sqrt(lower[j, j])
    for j in range(size):
        step[j] = right[j]
        for k in range(j):
            step[j] -= lower[j, k] * step[k]
        step[j] /= lower[j, j]
    for j in range(size - 1, -1, -1):
        for k in range(j + 1, size):
            step[j] -= lower[k, j] * step[k]
        step[j] /= lower[j, j]
    return True


# The Gold Standard refit: F of the projective reconstruction with least reprojection error (thesis 4.3, HZ 11.4.1),
# cost = sum_i c^2 log(1 + r_i^2 / c^2) (c = inf: least squares), with r_i the reprojection distance of match i.
#
# The points are eliminated exactly. The Schur complement of a point at its optimum leaves one equation per match:
# r_i, with the derivative x2 x1' / |gradient of x2' F x1| over F, both at the nearest exact match; of the twelve
# camera parameters only the seven of F count (thesis 2.34). Depth plays no part: points at infinity and near an
# epipole are no special case.

_DAMPING = DampingRange(first=1e-4, least=1e-12, most=1e12)
"""Damping of Levenberg-Marquardt steps relative to the curvature, as in the kernels above. Chosen by hand."""


def refine_reprojection(
    points: FloatArray, F: FloatArray, *, scale: float = np.inf, most_steps: int = 20
) -> FloatArray:
    """Move F to a local minimum of the cost above; `scale` is Cauchy's c, inf for least squares."""
    softness = 1.0 / (scale * scale)
    F = to_unit_norm(nearest_rank_two(to_unit_norm(F)))
    moves = _moves(points, F)
    cost, damping = _cost(moves, softness), _DAMPING.first

    def attempt(damping: float) -> tuple[FloatArray, FloatArray, float] | None:
        step = np.linalg.solve(normal + damping * np.diag(curvature), right)
        trial = to_unit_norm(nearest_rank_two(F + (step @ basis).reshape(3, 3)))
        trial_moves = _moves(points, trial)
        trial_cost = _cost(trial_moves, softness)
        return (trial, trial_moves, trial_cost) if trial_cost < cost else None

    for _ in range(most_steps):
        if not 0 < cost < np.inf:
            break
        basis = _tangent_basis(F)
        normal, right = _gold_normal_equations(points, F, moves, softness, basis)
        curvature = np.maximum(np.diag(normal), 1e-12 * np.diag(normal).max())
        step, damping = damped_step(attempt, damping, _DAMPING)
        if step is None:
            break
        before, (F, moves, cost) = cost, step
        if before - cost <= _COST_TOLERANCE * before:
            break
    return F


def _moves(points: FloatArray, F: FloatArray) -> FloatArray:
    """Return (N, 4) displacements from every match to the nearest exact match, where its best point projects."""
    return np.hstack(nearest_exact_matches(F, points[:, :2], points[:, 2:])) - points


def _cost(moves: FloatArray, softness: float) -> float:
    squared = (moves**2).sum(axis=1)
    return float((np.log1p(softness * squared) / softness if softness > 0 else squared).sum())


def _tangent_basis(F: FloatArray) -> FloatArray:
    """Return (7, 9) orthonormal directions that to first order keep the rank 2 and the norm 1 of F."""
    U, _, Vt = np.linalg.svd(F)
    basis: FloatArray = np.linalg.svd(np.stack([np.outer(U[:, 2], Vt[2]).ravel(), F.ravel()]))[2][2:]
    return basis


def _gold_normal_equations(
    points: FloatArray, F: FloatArray, moves: FloatArray, softness: float, basis: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return weighted J'J (7, 7) and -J'r (7,) over the directions of `basis`, the points eliminated."""
    exact1, exact2 = to_homogeneous(points[:, :2] + moves[:, :2]), to_homogeneous(points[:, 2:] + moves[:, 2:])
    gradient = np.hstack([(exact2 @ F)[:, :2], (exact1 @ F.T)[:, :2]])
    length = np.linalg.norm(gradient, axis=1)
    inverse = np.divide(1.0, length, out=np.zeros_like(length), where=length > 0)  # 0 at both epipoles
    residuals = -(moves * gradient).sum(axis=1) * inverse
    rows = (exact2[:, :, None] * exact1[:, None, :]).reshape(-1, 9) * inverse[:, None]
    jacobian = np.einsum("nk,jk->nj", rows, basis)  # einsum, because it sums in one thread and a fixed order
    weighted = jacobian / (1.0 + softness * (moves**2).sum(axis=1))[:, None]
    return np.einsum("nj,nk->jk", weighted, jacobian), -np.einsum("nj,n->j", weighted, residuals)


# The final fit: the estimator's own, optionally followed by a least-squares fit to its inliers (thesis 4.3). With
# fewer than eight inliers the model does not change.

Refit = Callable[[FloatArray, FloatArray, float], FloatArray]
"""(points, F, threshold) -> the final F."""


def _refit_eight_point(points: FloatArray, F: FloatArray, threshold: float) -> FloatArray:
    """Apply the 8-point algorithm (thesis 4.3.2)."""
    inliers = _inliers(points, F, threshold)
    return F if len(inliers) < 8 else fit_eight_point(inliers, np.ones(len(inliers)))


def refit_sampson(points: FloatArray, F: FloatArray, threshold: float) -> FloatArray:
    """Minimize the Sampson distance (thesis 4.2) of the inliers, starting from the 8-point fit."""
    inliers = _inliers(points, F, threshold)
    return refine_sampson(inliers, _refit_eight_point(points, F, threshold)) if len(inliers) >= 8 else F


def _refit_reprojection(points: FloatArray, F: FloatArray, threshold: float) -> FloatArray:
    """Minimize the reprojection distance (thesis 4.3), starting from the minimum of the Sampson distance."""
    inliers = _inliers(points, F, threshold)
    return F if len(inliers) < 8 else refine_reprojection(inliers, refit_sampson(points, F, threshold))


REFITS = {"eight-point": _refit_eight_point, "sampson": refit_sampson, "reprojection": _refit_reprojection}
"""Values of `EpipolarSettings.refit` besides "auto"."""


def choose_refit(name: str, own: Refit) -> Refit:
    """Return the estimator's own fit, followed by the named one in `REFITS` to its inliers unless "auto"."""
    if name == "auto":
        return own
    return lambda points, F, threshold: REFITS[name](points, own(points, F, threshold), threshold)


def _inliers(points: FloatArray, F: FloatArray, threshold: float) -> FloatArray:
    inliers = squared_distances(points, np.ascontiguousarray(F).reshape(9)) <= threshold * threshold
    return np.asfortranarray(points[inliers])
