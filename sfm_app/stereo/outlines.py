"""Outlines of depth maps: windows that reach an object spread its depth over what lies behind, in every photo alike.

A plain background has no texture of its own, so no check between photos removes this spill; but its gray tells.
"""

import cv2
import numpy as np
from numpy.typing import NDArray

from sfm_app.jit import kernel
from sfm_app.stereo.patch_match import BORDER
from sfm_app.stereo.view import GrayImage
from sfm_app.types.arrays import BoolArray, DepthArray, FloatArray

REACH_PX = BORDER + 1
"""A window centered this far from an outline still contains a pixel of the object; on a background without texture that
pixel alone decides."""
AROUND_PX = 2 * REACH_PX
"""Largest row and column difference of the pixels that are compared with one."""
BEHIND = 0.05
"""Relative depth difference beyond which a pixel lies behind another. Chosen by hand: a plane has it within `REACH_PX`
where it is seen at 5 degrees."""
LEAST_PIXELS = 5
"""Fewest pixels whose mean and variance describe a surface."""
NOISE_GRAY = 3.0
"""Smallest standard deviation of gray levels: sensor noise and compression artifacts."""
LEAST_ODDS = 8.0
"""Smallest likelihood ratio, what lies behind over the object, that moves a pixel there."""
UNIFORM_LOG_LIKELIHOOD = 0.5 * np.log(2.0 * np.pi) - np.log(256.0)
"""Log likelihood of a gray under the uniform distribution, for objects so thin that they consist of rim only."""


def settle_outlines(depth: DepthArray, image: GrayImage) -> DepthArray:
    """Give pixels beside an outline the depth behind it, 0 where there is none, if their gray is like what is behind.

    The grays of the object, away from its rim, and of what lies behind are each modeled as normally distributed around
    a pixel. Gaps narrower than two rims are not behind: they lie within surfaces.
    """
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * REACH_PX + 1, 2 * REACH_PX + 1))
    empty = cv2.morphologyEx((depth <= 0).view(np.uint8), cv2.MORPH_OPEN, disc).view(np.bool_)
    farthest = cv2.dilate(np.where(empty, np.float32(np.inf), depth), disc)
    rim = (depth > 0) & (farthest > (1.0 + BEHIND) * depth)
    settled, nearness = depth.copy(), np.divide(1.0, depth, out=np.zeros_like(depth), where=depth > 0)
    _settle(nearness, empty, rim, image, settled)
    return settled


@kernel
def _settle(nearness: DepthArray, empty: BoolArray, rim: BoolArray, image: GrayImage, settled: DepthArray) -> None:
    """Settle the pixels of the rim, by 1 / depth: on a plane it is linear."""
    height, width = nearness.shape
    sums = np.empty((2, 3))  # number, sum and sum of squares of grays behind, and of the object's
    for row in range(height):
        for col in range(width):
            if not rim[row, col]:
                continue
            near, across, down = nearness[row, col], slope(nearness, row, col, 0, 1), slope(nearness, row, col, 1, 0)
            sums[:] = 0.0
            nearest, behind = np.inf, np.float32(0)
            for i in range(max(row - AROUND_PX, 0), min(row + AROUND_PX + 1, height)):
                for j in range(max(col - AROUND_PX, 0), min(col + AROUND_PX + 1, width)):
                    ahead = nearness[i, j] - (near + across * (j - col) + down * (i - row))
                    is_behind = empty[i, j] or (nearness[i, j] > 0 and ahead < -BEHIND * near)
                    if not is_behind and (nearness[i, j] == 0 or rim[i, j] or ahead > BEHIND * near):
                        continue
                    gray, distance = float(image[i, j]), (i - row) ** 2 + (j - col) ** 2
                    if is_behind and distance < nearest:
                        nearest, behind = distance, nearness[i, j]
                    kind = 0 if is_behind else 1
                    sums[kind, 0] += 1.0
                    sums[kind, 1] += gray
                    sums[kind, 2] += gray * gray
            if sums[0, 0] < LEAST_PIXELS:
                continue
            own = float(image[row, col])
            object_likelihood = UNIFORM_LOG_LIKELIHOOD if sums[1, 0] < LEAST_PIXELS else log_likelihood(own, sums[1])
            if log_likelihood(own, sums[0]) > object_likelihood + np.log(LEAST_ODDS):
                settled[row, col] = 1.0 / behind if behind > 0.0 else 0.0


@kernel
def slope(values: NDArray[np.float32], row: int, col: int, down: int, across: int) -> float:
    """Return the change of values from a pixel to the next in a direction: the smaller of both sides', not a jump."""
    height, width = values.shape
    i, j, k, m = row + down, col + across, row - down, col - across
    ahead = values[i, j] - values[row, col] if i < height and j < width else np.inf
    before = values[row, col] - values[k, m] if k >= 0 and m >= 0 else np.inf
    least = ahead if abs(ahead) < abs(before) else before
    return float(least) if np.isfinite(least) else 0.0


@kernel
def log_likelihood(gray: float, sums: FloatArray) -> float:
    """Return that of a gray, normally distributed as others of a number, sum and sum of squares (3,)."""
    mean = sums[1] / sums[0]
    variance = max(sums[2] / sums[0] - mean * mean, 0.0) + NOISE_GRAY**2
    return float(-0.5 * ((gray - mean) ** 2 / variance + np.log(variance)))
