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
DISC = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * REACH_PX + 1, 2 * REACH_PX + 1))
AROUND_PX = 2 * REACH_PX
"""Largest row and column difference of the pixels that are compared with one."""
BEHIND = 0.05
"""Relative depth difference beyond which a pixel lies behind another. Chosen by hand: a plane has it within `REACH_PX`
where it is seen at 5 degrees."""
LEAST_PIXELS = 5
"""Fewest pixels whose mean and variance describe a surface."""
NOISE_GRAY = 3.0
"""Smallest standard deviation of gray levels: sensor noise and compression artifacts."""
PLAIN_GRAY = 8.0
"""Largest standard deviation of the grays of a plain surface: matching cannot tell where it ends. Chosen by hand."""
LEAST_ODDS = 8.0
"""Smallest likelihood ratio, what lies behind over the object, that removes a depth."""


def remove_spill(depth: DepthArray, image: GrayImage) -> DepthArray:
    """Remove depths beside an outline, (H, W), if their gray is like that of a plain surface, or of nothing, behind it.

    The grays of the object, away from its rim, and of what lies behind are each modeled as normally distributed around
    a pixel. Gaps narrower than two rims are not behind: they lie within surfaces.
    """
    empty = _broad_areas(depth <= 0)
    farthest = cv2.dilate(np.where(empty, np.float32(np.inf), depth), DISC)
    rim = (depth > 0) & (farthest > (1.0 + BEHIND) * depth)
    cleared, nearness = depth.copy(), np.divide(1.0, depth, out=np.zeros_like(depth), where=depth > 0)
    _remove(nearness, empty, rim, image, cleared)
    return cleared


def _broad_areas(empty: BoolArray) -> BoolArray:
    return np.asarray(cv2.morphologyEx(empty.view(np.uint8), cv2.MORPH_OPEN, DISC)).view(np.bool_)


@kernel
def _remove(nearness: DepthArray, empty: BoolArray, rim: BoolArray, image: GrayImage, cleared: DepthArray) -> None:
    """Judge the pixels of the rim, by 1 / depth: on a plane it is linear."""
    height, width = nearness.shape
    # number, sum and sum of squares of the grays behind, of the object's, and of those of its rim
    sums = np.empty((3, 3))
    for row in range(height):
        for col in range(width):
            if not rim[row, col]:
                continue
            near, across, down = nearness[row, col], _slope(nearness, row, col, 0, 1), _slope(nearness, row, col, 1, 0)
            sums[:] = 0.0
            for i in range(max(row - AROUND_PX, 0), min(row + AROUND_PX + 1, height)):
                for j in range(max(col - AROUND_PX, 0), min(col + AROUND_PX + 1, width)):
                    ahead = nearness[i, j] - (near + across * (j - col) + down * (i - row))
                    is_behind = empty[i, j] or (nearness[i, j] > 0 and ahead < -BEHIND * near)
                    if not is_behind and (nearness[i, j] == 0 or ahead > BEHIND * near):
                        continue
                    gray = float(image[i, j])
                    kind = 0 if is_behind else 1 if not rim[i, j] else 2
                    sums[kind, 0] += 1.0
                    sums[kind, 1] += gray
                    sums[kind, 2] += gray * gray
            if sums[1, 0] < LEAST_PIXELS:  # so thin that it consists of rim only
                sums[1] = sums[2]
            if _is_like(float(image[row, col]), sums[0], sums[1]):
                cleared[row, col] = 0.0


@kernel
def _is_like(gray: float, plain: FloatArray, other: FloatArray) -> bool:
    """Return whether a gray is more like those of a plain surface than like others, by their sums (3,)."""
    mean, variance = _describe(plain)
    other_mean, other_variance = _describe(other)
    if plain[0] < LEAST_PIXELS or variance > PLAIN_GRAY**2:
        return False
    odds = 0.5 * ((gray - other_mean) ** 2 / other_variance - (gray - mean) ** 2 / variance)
    return bool(odds + 0.5 * np.log(other_variance / variance) > np.log(LEAST_ODDS))


@kernel
def _describe(sums: FloatArray) -> tuple[float, float]:
    """Return mean and variance of grays."""
    count = max(sums[0], 1.0)
    mean = sums[1] / count
    return mean, max(sums[2] / count - mean * mean, 0.0) + NOISE_GRAY**2


@kernel
def _slope(values: NDArray[np.float32], row: int, col: int, down: int, across: int) -> float:
    """Return the change of values from a pixel to the next in a direction: the smaller of both sides', not a jump."""
    height, width = values.shape
    i, j, k, m = row + down, col + across, row - down, col - across
    ahead = values[i, j] - values[row, col] if i < height and j < width else np.inf
    before = values[row, col] - values[k, m] if k >= 0 and m >= 0 else np.inf
    least = ahead if abs(ahead) < abs(before) else before
    return float(least) if np.isfinite(least) else 0.0
