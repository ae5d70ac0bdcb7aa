"""The Gold Standard refit: F from a projective reconstruction of least reprojection error (thesis 4.3, HZ 11.4.1).

Levenberg-Marquardt over the twelve entries of the second canonical camera P2 = [M|p] (2.34; the first stays [I|0]) and
over all points, X = (u, v, 1, w): x1 shows the point at (u, v), x2 at M (u, v, 1)' + w p. w is the inverse of the depth
beyond the plane M, so that no point is at infinity. Each point meets one block of 3 x 3 of the normal equations only;
eliminated, they leave 12 x 12 (the Schur complement): time and memory grow with the matches, not with their square.
With r_i the 4D distance between match and reprojection::

    cost = sum_i c^2 log(1 + r_i^2 / c^2)          (c = inf: least squares)
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sfm_app.geometry.distances import nearest_exact_matches
from sfm_app.geometry.epipolar import canonical_cameras, cross_matrix, homogeneous, nearest_rank_two, unit_norm

FloatArray = NDArray[np.float64]

_SMALLEST_DAMPING, _LARGEST_DAMPING = 1e-12, 1e12
_ENOUGH = 1e-9
"""Relative decrease of the cost under which the search ends."""
_FLOOR = 1e-12
"""Least curvature: a match at the epipoles leaves w free, and the cameras of one F leave five directions free."""


@dataclass(frozen=True, slots=True, eq=False)
class _Reconstruction:
    """A second camera, the points, and what both leave of the matches."""

    P2: FloatArray
    """(3, 4)."""
    X: FloatArray
    """(N, 4), u, v, 1, w."""
    image: FloatArray
    """(N, 3) homogeneous images of X in view 2."""
    residuals: FloatArray
    """(N, 4) reprojection minus match, view 1 and view 2."""


def refine_reprojection(points: FloatArray, F: FloatArray, *, scale: float = np.inf, most_steps: int = 20) -> FloatArray:
    """Move F to a local minimum of the cost above.

    The five ways in which P2 can change without F (2.34: v and lambda) are left to the damping.

    Args:
        points: (N, 4) inliers, N >= 7, of magnitude about 1.
        F: (3, 3) start.
        scale: Cauchy scale c, in the units of `points`; inf for plain least squares.
        most_steps: most Levenberg-Marquardt steps.

    Returns:
        (3, 3), rank 2, Frobenius norm 1.
    """
    softness = 1.0 / (scale * scale)
    with np.errstate(divide="ignore", over="ignore", invalid="ignore"):  # a step too far: its cost is not smaller
        state = _triangulated(points, nearest_rank_two(F))
        cost, damping = _cost(state, softness), 1e-4
        for _ in range(most_steps):
            system, improved, before = _System(state, softness), False, cost
            while not improved and damping < _LARGEST_DAMPING:
                trial = system.solved(points, damping)
                cost = _cost(trial, softness)
                improved = cost < before
                damping = max(damping * 0.1, _SMALLEST_DAMPING) if improved else damping * 10.0
            if not improved:
                break
            state = trial
            if before - cost <= _ENOUGH * before:
                break
    return unit_norm(nearest_rank_two(cross_matrix(state.P2[:, 3]) @ state.P2[:, :3]))


def _triangulated(points: FloatArray, F: FloatArray) -> _Reconstruction:
    """Canonical cameras of F and the points that reproject best with them."""
    P2 = canonical_cameras(F)[1]
    exact1, exact2 = (homogeneous(x) for x in nearest_exact_matches(F, points[:, :2], points[:, 2:]))
    # x2 ~ M x1 + w p; crossed with x2: x2 x M x1 = -w x2 x p
    plane, towards = np.cross(exact2, exact1 @ P2[:, :3].T), np.cross(exact2, P2[:, 3])
    w = -(plane * towards).sum(axis=1) / np.maximum((towards**2).sum(axis=1), np.finfo(float).tiny)
    return _reprojected(points, P2, np.column_stack([exact1, w]))


def _reprojected(points: FloatArray, P2: FloatArray, X: FloatArray) -> _Reconstruction:
    image = X @ P2.T
    residuals = np.hstack([X[:, :2], image[:, :2] / image[:, 2:]]) - points
    return _Reconstruction(P2, X, image, residuals)


def _cost(state: _Reconstruction, softness: float) -> float:
    squared = (state.residuals**2).sum(axis=1)
    return float((np.log1p(softness * squared) / softness if softness > 0 else squared).sum())


class _System:
    """The normal equations at one reconstruction, with every point eliminated.

    Per point, e1 and e2 are the residuals in the two views, E (2, 3) the derivative of view 2 over (u, v, w) and
    V = diag(1, 1, 0) + E'E; D (2, 3) is the derivative of view 2 over its homogeneous image, so that D (x) X' is that
    over the camera.
    """

    def __init__(self, state: _Reconstruction, softness: float) -> None:
        self.state = state
        self.weights = 1.0 / (1.0 + softness * (state.residuals**2).sum(axis=1))
        x, y, z = state.image.T
        zero = np.zeros_like(z)
        self.D = np.stack([1 / z, zero, -x / z**2, zero, 1 / z, -y / z**2], axis=1).reshape(-1, 2, 3)
        self.E = np.einsum("nij,jk->nik", self.D, state.P2[:, [0, 1, 3]])
        self.V = np.einsum("nij,nik->njk", self.E, self.E)
        self.V[:, [0, 1], [0, 1]] += 1.0
        self.pull = np.einsum("nij,ni->nj", self.E, state.residuals[:, 2:])
        self.pull[:, :2] += state.residuals[:, :2]

    def solved(self, points: FloatArray, damping: float) -> _Reconstruction:
        """The reconstruction after one step, its diagonal raised by the share `damping`."""
        D, E, X, weights = self.D, self.E, self.state.X, self.weights
        freed = self.V.copy()
        freed[:, range(3), range(3)] *= 1.0 + damping
        freed[:, range(3), range(3)] += _FLOOR
        EV = np.einsum("nij,njk->nik", E, np.linalg.inv(freed))
        # what the points cannot take up: (I - E V^-1 E') for the camera's part, and of the residuals
        remains = np.eye(2) - np.einsum("nij,nkj->nik", EV, E)
        left = self.state.residuals[:, 2:] - np.einsum("nij,nj->ni", EV, self.pull)
        DX = (D[:, :, :, None] * X[:, None, None, :]).reshape(-1, 2, 12)
        weighted = weights[:, None, None] * DX
        schur = np.einsum("nia,nib->ab", weighted, np.einsum("nij,njb->nib", remains, DX))
        curvature = np.einsum("nia,nia->a", weighted, DX)
        schur[range(12), range(12)] += damping * curvature + _FLOOR * curvature.max()
        step = np.linalg.solve(schur, -np.einsum("nia,ni->a", weighted, left))
        moved = np.einsum("nij,nj->ni", np.einsum("nij,jk->nik", D, step.reshape(3, 4)), X)
        inward = self.pull + np.einsum("nij,ni->nj", E, moved)
        X = X.copy()
        X[:, [0, 1, 3]] -= np.einsum("nij,nj->ni", np.linalg.inv(freed), inward)
        return _reprojected(points, self.state.P2 + step.reshape(3, 4), X)
