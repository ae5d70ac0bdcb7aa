"""Visibility of points in photos by their depth maps."""

import numpy as np
from numpy.typing import NDArray

from sfm_app.jit import kernel
from sfm_app.types import PosedPhoto
from sfm_app.types.arrays import DepthArray, FloatArray

NO_EVIDENCE, CONFIRMED, SEEN_THROUGH, EMPTY = range(4)
SKY = -2.0
"""Depth of a pixel that shows the sky; COLMAP's fusion reads it as no depth."""
THROUGH = 3.0
"""A photo sees through a point if its depths lie at least this many tolerances behind the point."""


def judge(
    points: FloatArray, normals: FloatArray, photo: PosedPhoto, depth: DepthArray, sample_px: float, tolerance: float
) -> NDArray[np.uint8]:
    """Judge points on a surface: CONFIRMED, SEEN_THROUGH, EMPTY or NO_EVIDENCE.

    A point is CONFIRMED if it faces the photo and the surrounding depths agree with its own within the relative
    tolerance. It is SEEN_THROUGH if its pixel shows the sky, or if all four surrounding depths lie well behind it. It
    is EMPTY if it faces the photo and no depth around it is known. Hidden and masked points give NO_EVIDENCE.

    The normals (N, 3) are unit vectors; the tolerance is a relative difference in depth. The depth map has SKY where
    the photo shows the sky, and other negative values where it is masked; `sample_px` is the position of a depth in its
    pixel, in x and y, 0.5 at the center.
    """
    verdict = np.zeros(len(points), np.uint8)
    _judge(points, normals, photo.projection, photo.center, depth, np.array([sample_px, tolerance]), verdict)
    return verdict


@kernel
def _judge(
    points: FloatArray, normals: FloatArray, P: FloatArray, center: FloatArray, depth: DepthArray, options: FloatArray,
    verdict: NDArray[np.uint8],
) -> None:  # fmt: skip
    height, width = depth.shape
    sample_px, tolerance = options[0], options[1]
    for k in range(len(points)):
        X, Y, Z = points[k, 0], points[k, 1], points[k, 2]
        z = P[2, 0] * X + P[2, 1] * Y + P[2, 2] * Z + P[2, 3]
        if z <= 0:
            continue
        u = (P[0, 0] * X + P[0, 1] * Y + P[0, 2] * Z + P[0, 3]) / z - sample_px
        v = (P[1, 0] * X + P[1, 1] * Y + P[1, 2] * Z + P[1, 3]) / z - sample_px
        col, row = int(np.floor(u)), int(np.floor(v))
        if not (0 <= col < width - 1 and 0 <= row < height - 1):
            continue
        if depth[int(np.floor(v + 0.5)), int(np.floor(u + 0.5))] == SKY:
            verdict[k] = SEEN_THROUGH
            continue
        low, known, masked, agrees = _surrounding(depth, row, col, z, tolerance)
        if known == 0 and masked > 0:
            continue
        if agrees or known == 0:
            x, y, w = center[0] - X, center[1] - Y, center[2] - Z
            facing = normals[k, 0] * x + normals[k, 1] * y + normals[k, 2] * w
            if facing > 0.1 * np.sqrt(x * x + y * y + w * w):
                verdict[k] = EMPTY if known == 0 else CONFIRMED
        elif known == 4 and low > (1.0 + THROUGH * tolerance) * z:
            verdict[k] = SEEN_THROUGH


@kernel
def _surrounding(depth: DepthArray, row: int, col: int, z: float, tolerance: float) -> tuple[float, int, int, bool]:
    """Return the least of four depths, the numbers of known and masked ones, and whether they agree with z."""
    low, high, known, masked, near = np.inf, 0.0, 0, 0, False
    for i in range(row, row + 2):
        for j in range(col, col + 2):
            d = depth[i, j]
            if d > 0:
                low, high, known = min(low, d), max(high, d), known + 1
                near = near or abs(d - z) <= tolerance * z
            masked += d < 0
    # on a slope the four depths bracket the point's; across a step they are of different surfaces
    between = low <= z <= high and high - low <= 2.0 * THROUGH * tolerance * z
    return low, known, masked, near or between
