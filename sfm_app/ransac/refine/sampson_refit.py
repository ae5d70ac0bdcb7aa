"""Non-linear refinement of F on the Sampson distance (thesis 4.3, Eq. 4.2), over its seven degrees of freedom.

The parameters are those of `rank_two`. All fits are iteratively reweighted least squares: weigh the matches by their
distances, take one Levenberg-Marquardt step that lowers sum_i w_i r_i^2, weigh again. For a cost that is a concave
function of r^2, as robust costs are, such a step lowers the cost itself as well.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sfm_app.jit import kernel, summing_kernel
from sfm_app.ransac.refine.rank_two import compose, factorize, fill_tangent_basis, rotate
from sfm_app.ransac.scoring.leverage import mad_sigma
from sfm_app.ransac.scoring.robust_costs import FIRST, fill_squared_distances, squared_distances
from sfm_app.ransac.solvers.design_matrix import LANES, add_products, gather, mirror, weighted_gram

FloatArray = NDArray[np.float64]

_FIRST_DAMPING, _SMALLEST_DAMPING, _LARGEST_DAMPING = 1e-4, 1e-12, 1e12
"""Damping of Levenberg-Marquardt steps, relative to the curvature. Chosen by hand; not measured on their own."""
_COST_TOLERANCE = 1e-9
"""Relative decrease of the cost below which the iteration ends. Chosen by hand; not measured on its own."""
_LIKELIHOOD_TOLERANCE = 1e-4
"""Relative decrease of the cost below which the mixture fit ends. Chosen by hand; not measured on its own."""
_NEGLIGIBLE = 1e-3
"""Weight below which a match is left out of a step. Chosen by hand; not measured on its own."""
_LEAST_SIGMA = 0.02
"""Least sigma in thresholds: without it nearly perfect matches would exclude all others. Chosen by hand; not measured
on its own."""
_FIRST_SHARE, _MOST_SHARE = 0.9, 0.999
"""Share of inliers among the matches within reach: initial value and upper bound in expectation maximization. Chosen by
hand; not measured on their own."""
_FIRST_ROUNDS = 6
"""Rounds of expectation maximization before the first step; one before each later step. Chosen by hand; not measured
on its own."""
_LEAST_CURVATURE = 1e-9
"""Least curvature that damping multiplies, relative to the largest: matches may leave a direction of F free. Chosen by
hand; not measured on its own."""


class Weighting(NamedTuple):
    """How squared distances become weights: by a robust cost, or by a mixture of two densities."""

    is_mixture: bool = False
    softness: float = 0.0
    """1 / c^2 of the robust cost r^2 / (1 + r^2 / c^2); 0 for least squares. Not used by the mixture."""
    squared_reach: float = 0.0
    """Mixture: squared distance within which matches count; outliers are uniform up to this distance."""
    largest_variance: float = 0.0
    """Mixture: upper bound of the inliers' variance."""
    first_variance: float = 0.0
    """Mixture: initial variance in expectation maximization."""


def refine_sampson(
    points: FloatArray, F: FloatArray, *, scale: float = np.inf, most_steps: int = 20, enough: float = _COST_TOLERANCE
) -> FloatArray:
    """Move F towards a minimum of sum_i r_i^2 / (1 + r_i^2 / c^2) (Geman and McClure 1987).

    Args:
        points: (N, 4) matches.
        F: (3, 3) start.
        scale: c, in the units of `points`; inf for least squares.
        most_steps: largest number of Levenberg-Marquardt steps.
        enough: relative decrease of the cost below which to stop.

    Returns:
        (3, 3), rank 2, its largest singular value 1.
    """
    weighing = Weighting(softness=float(scale**-2))
    return _reweighted_least_squares(points, *factorize(F), weighing, most_steps, enough, np.empty((10, 10)))


def refine_mixture(points: FloatArray, F: FloatArray, *, threshold: float, reach: float, most_steps: int) -> FloatArray:
    """Estimate F with the sigma and share of inliers by maximum likelihood: EM (thesis 3.5 and 4.6).

    Among the matches within `reach` thresholds, signed distances of inliers are Gaussian about 0, those of outliers
    uniform. The weight of a match is the probability that it is an inlier. sigma is at most one threshold.

    Args:
        points: (N, 4) matches.
        F: (3, 3) start, near enough for its inliers to determine sigma.
        threshold: largest distance of an inlier.
        reach: thresholds within which matches count, > 1.
        most_steps: largest number of steps.

    Returns:
        (3, 3), rank 2, its largest singular value 1.
    """
    U, s, V = factorize(F)
    squared = squared_distances(points, compose(U, s, V))
    inside = squared[squared <= threshold * threshold]
    sigma = mad_sigma(np.sqrt(inside)) if len(inside) else threshold
    squared_reach = float((reach * threshold) ** 2)
    weighing = Weighting(
        is_mixture=squared_reach > 0.0,  # where the squared threshold underflows, fall back to least squares
        squared_reach=squared_reach,
        largest_variance=float(threshold**2),
        first_variance=float(min(sigma, threshold) ** 2),
    )
    return _reweighted_least_squares(points, U, s, V, weighing, most_steps, _LIKELIHOOD_TOLERANCE, np.empty((10, 10)))


def fit_eight_point(points: FloatArray, weights: FloatArray) -> FloatArray:
    """Apply the 8-point algorithm (thesis 4.3.2) on matches that are well scaled already.

    Args:
        points: (N, 4), of magnitude about 1.
        weights: (N,) >= 0, how much each squared algebraic error counts; at least eight positive ones.

    Returns:
        (3, 3), rank 2.
    """
    U, s, V = factorize(fit_algebraic(points, weights))
    return compose(U, s, V).reshape(3, 3)


def fit_algebraic(points: FloatArray, weights: FloatArray) -> FloatArray:
    """Return the (3, 3) matrix of norm 1 and any rank with the least algebraic error: `fit_eight_point` without rank 2.

    Args:
        points: (N, 4), of magnitude about 1.
        weights: (N,) >= 0, at least eight positive ones.
    """
    _, vectors = np.linalg.eigh(weighted_gram(points, weights))
    return np.ascontiguousarray(vectors[:, 0]).reshape(3, 3)


@kernel
def _reweighted_least_squares(
    points: FloatArray, U: FloatArray, s: float, V: FloatArray, weighing: Weighting, most_steps: int, enough: float,
    gram: FloatArray,
) -> FloatArray:  # fmt: skip
    """Weigh and step in turn until a step lowers the cost by less than the relative decrease `enough`.

    `gram` (10, 10) is a work array: if its size were known at compile time, the compiler would unroll all sums.
    """
    count = points.shape[0]
    weights, squared, trial = np.empty(count), np.empty(count), np.empty(count)
    normal, right, step = np.empty((7, 7)), np.empty(7), np.empty(7)
    f = compose(U, s, V)
    fill_squared_distances(points, f, FIRST, squared)
    damping, variance, share = _FIRST_DAMPING, weighing.first_variance, _FIRST_SHARE
    for n in range(most_steps):
        if weighing.is_mixture:
            rounds = _FIRST_ROUNDS if n == 0 else 1
            variance, share = _weigh_by_mixture(squared, weighing, variance, share, rounds, weights)
        else:
            _weigh_robustly(squared, weighing.softness, weights)
        cost = new_cost = _weighted_sum(squared, weights)
        _normal_equations(points, f, weights, U, s, V, gram, normal, right)
        improved = False
        while not improved and damping < _LARGEST_DAMPING:
            if _solve(normal, right, damping, step):
                U_new, V_new, s_new = rotate(U, step[0:3]), rotate(V, step[3:6]), s + step[6]
                new = compose(U_new, s_new, V_new)
                fill_squared_distances(points, new, FIRST, trial)
                new_cost = _weighted_sum(trial, weights)
                improved = new_cost < cost
            damping = max(damping * 0.1, _SMALLEST_DAMPING) if improved else damping * 10.0
        if not improved:
            break
        U, V, s, f = U_new, V_new, s_new, new
        squared, trial = trial, squared
        if cost - new_cost <= enough * cost:
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
        variance = min(max(variance, _LEAST_SIGMA * _LEAST_SIGMA * largest), largest)
        share = min(max(total / max(near, 1), 1.0 - _MOST_SHARE), _MOST_SHARE)
    return variance, share


@summing_kernel
def _weighted_sum(squared: FloatArray, weights: FloatArray) -> float:
    total = 0.0
    for i in range(squared.shape[0]):
        total += weights[i] * squared[i] if weights[i] > 0.0 else 0.0
    return total


@kernel
def _normal_equations(
    points: FloatArray, f: FloatArray, weights: FloatArray, U: FloatArray, s: float, V: FloatArray,
    gram: FloatArray, normal: FloatArray, right: FloatArray,
) -> None:  # fmt: skip
    """Write the weighted J'J and -J'r of the seven parameters to `normal` and `right`."""
    size = gram.shape[0]
    for j in range(size):
        for k in range(size):
            gram[j, k] = 0.0
    block, rows = np.empty((5, LANES)), np.empty((size, LANES))
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
    """Write dr / dF (9 rows) and r (the last row) of the matches of a block, times sqrt(weight).

    r = n / g with n = x2' F x1 and g the norm of its gradient: dr = dn / g - r dg / g.
    """
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
def _solve(normal: FloatArray, right: FloatArray, damping: float, step: FloatArray) -> bool:
    """Write the Cholesky solution of (normal + damping diag(normal)) step = right.

    Returns False if the matrix is not positive definite.
    """
    lower = normal.copy()
    largest = 0.0
    for j in range(7):
        largest = max(largest, normal[j, j])
    for j in range(7):
        lower[j, j] += damping * max(normal[j, j], _LEAST_CURVATURE * largest)
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
