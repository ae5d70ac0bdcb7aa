"""Plane and parallax: the right epipole for a model found on a dominant plane (after Chum, Werner and Matas 2005).

Samples from a scene with one large plane mostly lie on it; their F has the right homography H of the plane, but a wrong
epipole. With H given, two matches off the plane are a minimal sample: the lines from H x1 to x2 meet in the epipole.
"""

import numpy as np
from numpy.typing import NDArray

from sfm_app.jit import kernel
from sfm_app.ransac.degeneracy.dominant_plane import OFF_PLANE, dominant_homography, transfer_distance
from sfm_app.ransac.sampling.minimal_samples import RandomState, uniform
from sfm_app.ransac.scoring.robust_costs import FIRST, Loss, penalty, squared_distances
from sfm_app.ransac.verification.pretests import PreTest

FloatArray = NDArray[np.float64]

_SAMPLES = 100
"""Samples of two matches off the plane. Chosen by hand; halved and doubled by `benchmarks.sensitivity`."""
_LEAST_INLIERS = 8
"""Fewer do not determine the dominant plane. Chosen by hand; halved and doubled by `benchmarks.sensitivity`."""
_MOST_INLIERS = 300
"""Largest number of inliers that the plane is fitted to. Chosen by hand; halved and doubled by
`benchmarks.sensitivity`."""


def recover_epipole(
    points: FloatArray, F: FloatArray, threshold: float, loss: Loss, pretest: PreTest, state: RandomState
) -> FloatArray | None:
    """Estimate the best model with the dominant plane of F's inliers; None without a plane and two matches off it.

    Args:
        points, F: (N, 4) in random order, and (3, 3).
        threshold: largest distance of an inlier.
        loss: the penalty.
        pretest: the test that a model has to pass, without a random start.
        state: random generator.
    """
    inliers = squared_distances(points, np.ascontiguousarray(F).reshape(9)) <= threshold * threshold
    if np.count_nonzero(inliers) < _LEAST_INLIERS:
        return None
    chosen = np.asfortranarray(points[np.flatnonzero(inliers)[:_MOST_INLIERS]])
    H = dominant_homography(chosen, F, threshold)
    off_plane = np.flatnonzero(transfer_distance(H, points) > OFF_PLANE * threshold)
    if len(off_plane) < 2:
        return None
    best = np.empty(9)
    found = _search_epipole(points, H, off_plane, loss, pretest, state, best)
    return best.reshape(3, 3) if np.isfinite(found) else None


@kernel
def _search_epipole(
    points: FloatArray, H: FloatArray, off_plane: NDArray[np.int64], loss: Loss, pretest: PreTest, state: RandomState,
    best: FloatArray,
) -> float:  # fmt: skip
    lowest, line, f = np.inf, np.empty((2, 3)), np.empty(9)
    for _ in range(_SAMPLES):
        for k in range(2):
            i = off_plane[int(uniform(state) * off_plane.shape[0])]
            hx = H[0, 0] * points[i, 0] + H[0, 1] * points[i, 1] + H[0, 2]
            hy = H[1, 0] * points[i, 0] + H[1, 1] * points[i, 1] + H[1, 2]
            hz = H[2, 0] * points[i, 0] + H[2, 1] * points[i, 1] + H[2, 2]
            line[k, 0] = hy - hz * points[i, 3]
            line[k, 1] = hz * points[i, 2] - hx
            line[k, 2] = hx * points[i, 3] - hy * points[i, 2]
        ex = line[0, 1] * line[1, 2] - line[0, 2] * line[1, 1]
        ey = line[0, 2] * line[1, 0] - line[0, 0] * line[1, 2]
        ez = line[0, 0] * line[1, 1] - line[0, 1] * line[1, 0]
        for c in range(3):
            f[c] = ey * H[2, c] - ez * H[1, c]
            f[3 + c] = ez * H[0, c] - ex * H[2, c]
            f[6 + c] = ex * H[1, c] - ey * H[0, c]
        squared = 0.0
        for c in range(9):
            squared += f[c] * f[c]
        if not squared > 0.0:
            continue
        for c in range(9):
            f[c] /= np.sqrt(squared)
        score = penalty(points, FIRST, f, loss, lowest, pretest)
        if score < lowest:
            lowest = score
            for c in range(9):
                best[c] = f[c]
    return lowest
