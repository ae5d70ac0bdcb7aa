"""The pixels of a sky, given its cells: up to the outlines of what stands before it."""

import cv2
import numpy as np
from numpy.typing import NDArray

from sfm_app.stereo.view import GrayImage

REACH = 0.02
"""How far beyond its cells a sky is looked for, in longer sides of the photo: as far as semi-global matching carries
depths on. Chosen on `garden` and `ornament`."""
TOLERANCE = 3.0
"""Largest difference in gray levels from the sky around, after noise is smoothed; real skies vary by 1. Chosen on
`railing`, together with the rim."""
NARROW_PX, RIM_PX = 9, 3
"""Width below which a thing before the sky is narrow, and the rim of depths that it keeps on each side: fewer pixels of
depths are too few for a surface. Chosen on `railing`: 72 % of its thin things are found, and 69 % with a rim of 2 and a
tolerance of 4."""
BUMP_PX = 1
"""Beside what is broad, this is a ragged outline and no narrow thing. Chosen on the fisheye demo."""
BLUR_PX = 2
"""Pixels beside a sky that are part sky, part what stands before it; matching gives them depths of their own. Chosen on
castle-P19, where photos that are left out fit 0.15 dB better with 1 and 0.4 dB better with 2; railing was left out."""
STEADY = 0.3
"""Added, in squared cells, to the variance of the places by which the slope of a sky is told: few cells in a row tell
none across it. Chosen on the fisheye demo; railing, garden, courtyard and town were left out: 0.1 to 1 help all."""
LEAST_WEIGHT = 1e-4
"""Of the sky around that is averaged. By definition: rounding."""


def sky_pixels(photo: GrayImage, cells: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Mark the pixels (H, W) of the sky: near its cells, of the gray level that it has there, and blurred with it.

    Args:
        photo: (H, W).
        cells: (h, w) cells of the sky.
    """
    if not cells.any():
        return np.zeros(photo.shape, bool)
    around = cv2.resize(_continue_sky(photo, cells), photo.shape[::-1])
    smooth = cv2.GaussianBlur(photo.astype(np.float32), (3, 3), 0)  # a median would swallow wires
    sky = near_pixels(cells, photo.shape) & (np.abs(smooth - around) <= TOLERANCE)
    return _widen(sky, BLUR_PX) & ~_find_narrow_rims(sky)


def near_pixels(cells: NDArray[np.bool_], shape: tuple[int, ...]) -> NDArray[np.bool_]:
    """Mark the pixels (H, W) in cells and within reach of them.

    Args:
        cells: (h, w).
        shape: (H, W).
    """
    side = 2 * round(REACH * max(cells.shape)) + 1
    near = cv2.dilate(cells.view(np.uint8), np.ones((side, side), np.uint8))
    return np.asarray(cv2.resize(near, shape[::-1], interpolation=cv2.INTER_NEAREST) > 0)


def _continue_sky(photo: GrayImage, cells: NDArray[np.bool_]) -> NDArray[np.float32]:
    """Return (h, w) the gray level of the sky around each cell, continued along its slope: skies pale downwards."""
    gray = cv2.resize(photo, cells.shape[::-1], interpolation=cv2.INTER_AREA).astype(np.float64)
    y, x = np.mgrid[: cells.shape[0], : cells.shape[1]].astype(np.float64)
    weight = np.maximum(_blur(cells.astype(np.float64)), LEAST_WEIGHT)
    x_mean, y_mean, level = (_blur(cells * values) / weight for values in (x, y, gray))
    # variances and covariances of place and gray level, as a plane is fitted
    xx = _blur(cells * x * x) / weight - x_mean * x_mean + STEADY
    yy = _blur(cells * y * y) / weight - y_mean * y_mean + STEADY
    xy = _blur(cells * x * y) / weight - x_mean * y_mean
    xg, yg = _blur(cells * x * gray) / weight - x_mean * level, _blur(cells * y * gray) / weight - y_mean * level
    slope_x, slope_y = yy * xg - xy * yg, xx * yg - xy * xg
    slopes = slope_x * (x - x_mean) + slope_y * (y - y_mean)
    return np.asarray(level + slopes / (xx * yy - xy * xy), np.float32)


def _blur(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return sums (h, w) of the values around each cell, those nearby with more weight."""
    return np.asarray(cv2.GaussianBlur(values, (0, 0), REACH * max(values.shape)), np.float64)


def _find_narrow_rims(sky: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Mark pixels beside things before the sky that are narrow, such as branches: they keep a rim."""
    things = ~sky
    window = np.ones((NARROW_PX, NARROW_PX), np.uint8)
    broad = cv2.morphologyEx(things.view(np.uint8), cv2.MORPH_OPEN, window) > 0
    return _widen(things & ~_widen(broad, BUMP_PX), RIM_PX)


def _widen(mask: NDArray[np.bool_], pixels: int) -> NDArray[np.bool_]:
    """Return the mask with everything that is at most some pixels beside it."""
    side = 2 * pixels + 1
    return np.asarray(cv2.dilate(mask.view(np.uint8), np.ones((side, side), np.uint8)) > 0)
