"""How well F explains all matches: penalties on the Sampson distance, with early exits (thesis 4.4.1).

A penalty is to be made small. Early exit by the bail-out test (Capel 2005; thesis 4.4.4): the matches come in random
order, so that after a few blocks it is clear that a hypothesis cannot beat the best one.
"""

import numpy as np
from numpy.typing import NDArray

from sfm_app.jit import kernel

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

RANSAC = 0
"""Penalty 1 beyond the threshold, else 0 (thesis 3.20, 4.4)."""
MSAC = 1
"""The squared distance, at most the squared threshold (Torr and Zisserman 2000)."""
MSAC_LINEAR = 2
"""The distance, at most the threshold (thesis 4.5 as printed)."""

BLOCK = 32
"""Matches between two looks at whether to go on."""

_BAIL_OUT_SIGMAS = 3.0


@kernel
def squared_sampson(f: FloatArray, x1: float, y1: float, x2: float, y2: float) -> float:
    """Squared Sampson distance (thesis 4.2) of one match to f, the nine entries of F by rows."""
    ax, ay, az = f[0] * x1 + f[1] * y1 + f[2], f[3] * x1 + f[4] * y1 + f[5], f[6] * x1 + f[7] * y1 + f[8]
    bx, by = f[0] * x2 + f[3] * y2 + f[6], f[1] * x2 + f[4] * y2 + f[7]
    algebraic = x2 * ax + y2 * ay + az
    gradient = ax * ax + ay * ay + bx * bx + by * by
    return algebraic * algebraic / gradient if gradient > 0.0 else np.inf


@kernel
def squared_distances(points: FloatArray, f: FloatArray) -> FloatArray:
    """(N,) squared Sampson distances of all matches (N, 4)."""
    squared = np.empty(points.shape[0])
    for i in range(points.shape[0]):
        squared[i] = squared_sampson(f, points[i, 0], points[i, 1], points[i, 2], points[i, 3])
    return squared


@kernel
def _penalty(kind: int, squared: float, limit: float) -> float:
    if kind == RANSAC:
        return 0.0 if squared < limit else 1.0
    if kind == MSAC:
        return squared
    return float(np.sqrt(squared))


@kernel
def penalty(
    points: FloatArray, f: FloatArray, kind: int, threshold: float, to_beat: float, least_inliers: IntArray
) -> float:
    """Sum of the penalties of all matches, or inf as soon as f has no prospect of staying below `to_beat`.

    Args:
        points: (N, 4), in random order.
        f: (9,) entries of F.
        kind: RANSAC, MSAC or MSAC_LINEAR.
        threshold: largest distance of an inlier.
        to_beat: best penalty so far; inf for a full count.
        least_inliers: from `bail_out_table`; empty for no such test.
    """
    limit = threshold * threshold
    worst = _penalty(kind, limit, limit)
    total, inliers, block = 0.0, 0, 0
    start, count = 0, points.shape[0]
    while start < count:
        stop = min(start + BLOCK, count)
        for i in range(start, stop):
            squared = squared_sampson(f, points[i, 0], points[i, 1], points[i, 2], points[i, 3])
            if squared <= limit:
                inliers += 1
                total += _penalty(kind, squared, limit)
            else:
                total += worst
        if total >= to_beat or (block < least_inliers.shape[0] and inliers < least_inliers[block]):
            return np.inf
        start = stop
        block += 1
    return total


def bail_out_table(count: int, inlier_share: float) -> IntArray:
    """How many inliers a hypothesis must show after each block to be worth finishing.

    A hypothesis as good as the best one has a share `inlier_share` of inliers; in the first m of N matches their
    number is hypergeometric, and falls short of the figures given here about once in a thousand times.

    Returns:
        (blocks,) counts.
    """
    seen = np.arange(BLOCK, count, BLOCK, dtype=np.float64)
    mean = seen * inlier_share
    deviation = np.sqrt(mean * (1 - inlier_share) * (count - seen) / max(count - 1, 1))
    return np.maximum(np.floor(mean - _BAIL_OUT_SIGMAS * deviation), 0).astype(np.int64)
