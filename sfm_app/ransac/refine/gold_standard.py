"""The Gold Standard refit: F of the projective reconstruction with least reprojection error (thesis 4.3, HZ 11.4.1)::

    cost = sum_i c^2 log(1 + r_i^2 / c^2)          (c = inf: least squares)

with r_i the reprojection distance of match i, which is already minimized over its point X_i. Bundle adjustment of two
views has twelve camera parameters and three per point, but of the twelve only the seven of F count (2.34: v and lambda
are free), and the Schur complement of a point at its optimum leaves one equation per match: r_i, with the derivative
x2 x1' / |gradient of x2' F x1| over F, both evaluated at the nearest exact match. So this is Levenberg-Marquardt over
F alone, with the points eliminated exactly. It needs no depth: points at infinity are no special case, and points near
an epipole, whose depth is undetermined, do not hold back the others. Time and memory grow with the number of matches.
"""

import numpy as np
from numpy.typing import NDArray

from sfm_app.geometry.damping import DampingRange, damped_step
from sfm_app.geometry.distances import nearest_exact_matches
from sfm_app.geometry.epipolar import nearest_rank_two, to_homogeneous, to_unit_norm

FloatArray = NDArray[np.float64]

DAMPING = DampingRange(first=1e-4, least=1e-12, most=1e12)
"""Damping of Levenberg-Marquardt steps. Chosen by hand; halved and doubled by `benchmarks.sensitivity`."""
_COST_TOLERANCE = 1e-9
"""Relative decrease of the cost below which the iteration ends. Chosen by hand; halved and doubled by
`benchmarks.sensitivity`."""
_LEAST_CURVATURE = 1e-12
"""Least curvature, relative to the largest: some matches leave a direction of F free. Chosen by hand; halved and
doubled by `benchmarks.sensitivity`."""


def refine_reprojection(
    points: FloatArray, F: FloatArray, *, scale: float = np.inf, most_steps: int = 20
) -> FloatArray:
    """Move F to a local minimum of the cost above.

    Args:
        points: (N, 4) inliers, of magnitude about 1.
        F: (3, 3) start.
        scale: Cauchy scale c, in the units of `points`; inf for plain least squares.
        most_steps: largest number of Levenberg-Marquardt steps.

    Returns:
        (3, 3), rank 2, Frobenius norm 1.

    Raises:
        NumericalError: F is zero or not finite.
    """
    softness = 1.0 / (scale * scale)
    F = to_unit_norm(nearest_rank_two(to_unit_norm(F)))
    moves = _moves(points, F)
    cost, damping = _cost(moves, softness), DAMPING.first

    def attempt(tried: float) -> tuple[FloatArray, FloatArray, float] | None:
        step = np.linalg.solve(normal + tried * np.diag(curvature), right)
        trial = to_unit_norm(nearest_rank_two(F + (step @ basis).reshape(3, 3)))
        reached = _moves(points, trial)
        lower = _cost(reached, softness)
        return (trial, reached, lower) if lower < cost else None

    for _ in range(most_steps):
        if not 0 < cost < np.inf:
            break
        basis = _tangent_basis(F)
        normal, right = _normal_equations(points, F, moves, softness, basis)
        curvature = np.maximum(np.diag(normal), _LEAST_CURVATURE * np.diag(normal).max())
        found, damping = damped_step(attempt, damping, DAMPING)
        if found is None:
            break
        before, (F, moves, cost) = cost, found
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


def _normal_equations(
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
