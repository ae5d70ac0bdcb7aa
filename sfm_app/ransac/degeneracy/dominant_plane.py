"""The plane that holds most of a model's inliers, and the matches off it.

Hartley and Zisserman (2004), Result 13.6, as a regression whose weights are ours.

Where one homography H explains the matches, every F = [e]x H does, for any epipole e: the estimator then picks the e
that gets the most inliers by chance. The evidence for an epipole is matches off the plane.
"""

import numpy as np
from numpy.typing import NDArray

from sfm_app.jit import kernel
from sfm_app.ransac.refine.rank_two import factorize
from sfm_app.ransac.sampling.minimal_samples import uniform
from sfm_app.ransac.solvers.eigenvalues import decompose_symmetric

FloatArray = NDArray[np.float64]

OFF_PLANE = 2.0
"""Transfer distance in thresholds beyond which a match is off the plane. Chosen by hand; halved and doubled by
`benchmarks.sensitivity`."""
_SAMPLES, _SAMPLE_SIZE = 64, 3
"""Samples of three matches: a plane that holds half of them is missed twice in ten thousand times, (7/8)^64. Chosen by
hand; halved and doubled by `benchmarks.sensitivity`."""
_LEAST_AREA = 1e-3
"""Twice the area of the triangle of a sample, in squares of the points' spread: thinner ones determine no plane. Chosen
by hand; halved and doubled by `benchmarks.sensitivity`."""
_MOST_SCORED = 300
"""Matches that a sampled plane is scored on. Chosen by hand; halved and doubled by `benchmarks.sensitivity`."""
_LEAST_SUPPORT = 1e-12
"""Smallest over largest eigenvalue of the regression for a plane. Double precision leaves 1e-16 of the largest. Chosen
by hand; halved and doubled by `benchmarks.sensitivity`."""


@kernel
def dominant_homography(points: FloatArray, F: FloatArray, threshold: float) -> FloatArray:
    """Return the homography of the plane that holds the most matches, among those compatible with F.

    Such homographies are H = A - e2 v' with A = [e2]x F and v' x1 = b for every match on the plane, where
    b = (x2 x A x1)'(x2 x e2) / |x2 x e2|^2 (Hartley and Zisserman, Result 13.6): a linear regression with three
    parameters. Its noise is proportional to 1 / |x2 x e2|, so each match has the weight |x2 x e2|^2.

    Args:
        points: (N, 4) inliers of F in random order, N >= 3.
        F: (3, 3).
        threshold: largest distance of a match to the plane.

    Returns:
        (3, 3), x2 ~ H x1.
    """
    U, _, _ = factorize(F)
    e2, A = np.empty(3), np.empty((3, 3))
    for i in range(3):
        e2[i] = U[i, 2]
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        for n in range(3):
            A[i, n] = e2[j] * F[k, n] - e2[k] * F[j, n]
    b, weights = _plane_equations(points, A, e2)
    best = _sample_plane(points, b, A, e2, 2.0 * threshold * threshold)
    H = _homography(A, e2, best)
    squared, on_plane = _squared_transfer_distances(points, H), 0
    for i in range(points.shape[0]):
        if squared[i] <= threshold * threshold:
            on_plane += 1
        else:
            weights[i] = 0.0
    if on_plane >= _SAMPLE_SIZE and _fit_plane(points, b, weights, best):
        H = _homography(A, e2, best)
    return H


@kernel
def _homography(A: FloatArray, e2: FloatArray, v: FloatArray) -> FloatArray:
    """Return A - e2 v'."""
    H = np.empty((3, 3))
    for i in range(3):
        for j in range(3):
            H[i, j] = A[i, j] - e2[i] * v[j]
    return H


@kernel
def _plane_equations(points: FloatArray, A: FloatArray, e2: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return b of every match, and |x2 x e2|^2, the weight of its equation v' x1 = b."""
    b, weights = np.empty(points.shape[0]), np.empty(points.shape[0])
    for i in range(points.shape[0]):
        x1, y1, x2, y2 = points[i, 0], points[i, 1], points[i, 2], points[i, 3]
        px, py = A[0, 0] * x1 + A[0, 1] * y1 + A[0, 2], A[1, 0] * x1 + A[1, 1] * y1 + A[1, 2]
        pz = A[2, 0] * x1 + A[2, 1] * y1 + A[2, 2]
        tx, ty, tz = y2 * e2[2] - e2[1], e2[0] - x2 * e2[2], x2 * e2[1] - y2 * e2[0]
        weights[i] = tx * tx + ty * ty + tz * tz
        along = (y2 * pz - py) * tx + (px - x2 * pz) * ty + (x2 * py - y2 * px) * tz
        b[i] = along / max(weights[i], 1e-300)
    return b, weights


@kernel
def _fit_plane(points: FloatArray, b: FloatArray, weights: FloatArray, plane: FloatArray) -> bool:
    """Fit v' x1 = b by weighted least squares and write v to `plane` (3,).

    Returns False and writes nothing for points on one line.
    """
    gram, values, vectors = np.zeros((3, 3)), np.empty(3), np.empty((3, 3))
    right, row = np.zeros(3), np.ones(3)
    for i in range(points.shape[0]):
        row[0], row[1] = points[i, 0], points[i, 1]
        for j in range(3):
            right[j] += weights[i] * row[j] * b[i]
            for k in range(3):
                gram[j, k] += weights[i] * row[j] * row[k]
    decompose_symmetric(gram, values, vectors)
    if not values[0] > _LEAST_SUPPORT * values[2]:
        return False
    for j in range(3):
        plane[j] = 0.0
    for n in range(3):
        along = 0.0
        for j in range(3):
            along += vectors[j, n] * right[j]
        for j in range(3):
            plane[j] += along / values[n] * vectors[j, n]
    return True


@kernel
def _sample_plane(points: FloatArray, b: FloatArray, A: FloatArray, e2: FloatArray, limit: float) -> FloatArray:
    """Return the v through three sampled matches whose H maps most of the first matches to within sqrt(limit)."""
    count, most, state = min(points.shape[0], _MOST_SCORED), -1, np.empty(1, dtype=np.uint64)
    best, corner, v = np.zeros(3), np.empty(3, dtype=np.int64), np.empty(3)
    state[0] = count
    mapped = np.empty((3, count))
    for i in range(count):
        for r in range(3):
            mapped[r, i] = A[r, 0] * points[i, 0] + A[r, 1] * points[i, 1] + A[r, 2]
    for _ in range(_SAMPLES):
        for k in range(3):
            corner[k] = int(uniform(state) * count)
        p, q, r = corner[0], corner[1], corner[2]
        x, y = points[q, 0] - points[p, 0], points[q, 1] - points[p, 1]
        z, w = points[r, 0] - points[p, 0], points[r, 1] - points[p, 1]
        area = x * w - z * y
        if not abs(area) > _LEAST_AREA:
            continue
        v[0] = ((b[q] - b[p]) * w - (b[r] - b[p]) * y) / area
        v[1] = (x * (b[r] - b[p]) - z * (b[q] - b[p])) / area
        v[2] = b[p] - v[0] * points[p, 0] - v[1] * points[p, 1]
        on_plane = 0
        for i in range(count):
            along = v[0] * points[i, 0] + v[1] * points[i, 1] + v[2]
            depth = mapped[2, i] - e2[2] * along
            dx = mapped[0, i] - e2[0] * along - points[i, 2] * depth
            dy = mapped[1, i] - e2[1] * along - points[i, 3] * depth
            on_plane += dx * dx + dy * dy <= limit * depth * depth
        if on_plane > most:
            most = on_plane
            for k in range(3):
                best[k] = v[k]
    return best


def transfer_distance(H: FloatArray, points: FloatArray) -> FloatArray:
    """Return (N,) |x2 - H x1| / sqrt(2): about the distance in 4D of (x1, x2) to the nearest match that fits H exactly.

    Args:
        H: (3, 3) homography, view 2 from view 1.
        points: (N, 4) matches, in the same frame.
    """
    return np.sqrt(_squared_transfer_distances(points, H))


@kernel
def _squared_transfer_distances(points: FloatArray, H: FloatArray) -> FloatArray:
    squared = np.empty(points.shape[0])
    for i in range(points.shape[0]):
        x, y = points[i, 0], points[i, 1]
        depth = H[2, 0] * x + H[2, 1] * y + H[2, 2]
        dx = (H[0, 0] * x + H[0, 1] * y + H[0, 2]) / depth - points[i, 2]
        dy = (H[1, 0] * x + H[1, 1] * y + H[1, 2]) / depth - points[i, 3]
        squared[i] = (dx * dx + dy * dy) / 2.0 if depth != 0.0 else np.inf
    return squared
