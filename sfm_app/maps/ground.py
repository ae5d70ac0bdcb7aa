"""Bare ground under houses, trees and things: the simple morphological filter of Pingel, Clarke and McBride (2013).

No wheel for all versions of Python has a filter; this one is openings by OpenCV, with the values of the paper.
"""

from collections.abc import Callable
from math import ceil
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from sfm_app.types.arrays import BoolArray

CELL_M = 0.5
"""Least side of a cell of the lowest heights. Chosen by hand: half of the paper's, whose clouds are sparser."""
WINDOW_M = 18.0
"""Radius of the largest opening, which no house contains. From the paper, as are the slope and its weight."""
SLOPE = 0.15
"""Least slope, over the radius of an opening, at which what it removes is no ground."""
TOLERANCE_M = 0.25
"""Largest height of ground above the provisional ground where that is level: half of the paper's, as the cells."""
SMOOTHINGS = 3
"""Averages of 3 x 3 cells over what is filled: GDAL looks in four directions, which leaves streaks. Chosen by hand."""
SLOPE_WEIGHT = 1.25
"""Meters of tolerance for each unit of its slope."""


def bare_ground(heights: NDArray[np.float32], pixel_m: float, height_m: float) -> NDArray[np.float32]:
    """Return the ground (H, W) below a surface (H, W), NaN in holes; the sizes are meters per pixel and per height.

    What is higher than the ground is filled from its surroundings, up to the window; the rest stays open.
    """
    step = max(round(CELL_M / pixel_m), 1)
    cell_m, size = step * pixel_m, (heights.shape[1], heights.shape[0])
    meters = heights * np.float32(height_m)
    lowest = _by_cells(meters, step, np.min)
    is_object = _find_objects(lowest, cell_m)
    ground = _fill(np.where(is_object, np.float32(np.nan), lowest), WINDOW_M / cell_m)
    tolerance = TOLERANCE_M + SLOPE_WEIGHT * np.hypot(*np.gradient(ground, cell_m))
    below, reach, beside = (_enlarge(picture, step, size) for picture in (ground, tolerance, is_object))
    is_ground = (np.abs(meters - below) <= reach) & (beside == 0.0)  # also no foot of a tree
    means = _by_cells(np.where(is_ground, meters, np.float32(np.nan)), step, np.mean)
    filled = _enlarge(_fill(means, WINDOW_M / cell_m), step, size) / np.float32(height_m)
    return np.where(np.isnan(heights), np.float32(np.nan), np.where(is_ground, heights, filled))


def _by_cells(heights: NDArray[np.float32], step: int, combine: Callable[..., Any]) -> NDArray[np.float32]:
    """Return the least or the mean height of each cell of step x step pixels; NaN in empty ones."""
    rows, columns = (-(-side // step) for side in heights.shape)
    padded = np.full((rows * step, columns * step), np.nan, np.float32)
    padded[: heights.shape[0], : heights.shape[1]] = heights
    cells = np.ma.masked_invalid(padded.reshape(rows, step, columns, step))
    return np.asarray(combine(cells, axis=(1, 3)).filled(np.nan), np.float32)


def _find_objects(cells: NDArray[np.float32], cell_m: float) -> BoolArray:
    """Return the cells from which openings of rising radius take more than a slope would explain.

    Slopes count from the plane of the whole.
    """
    before = _fill(cells, float(max(cells.shape)))
    y, x = np.indices(cells.shape)
    plane = np.stack([x.ravel(), y.ravel(), np.ones(x.size)], axis=1)
    trend = plane @ np.linalg.lstsq(plane, before.ravel(), rcond=None)[0]
    before = (before - trend.reshape(cells.shape)).astype(np.float32)  # openings take off the upper end of a slope
    is_object = np.zeros(cells.shape, np.bool_)
    for radius in range(1, ceil(WINDOW_M / cell_m) + 1):
        disk = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1))
        after = np.asarray(cv2.morphologyEx(before, cv2.MORPH_OPEN, disk), np.float32)
        is_object |= before - after > SLOPE * radius * cell_m
        before = after
    return is_object


def _fill(heights: NDArray[np.float32], reach: float) -> NDArray[np.float32]:
    """Return heights with values where they were NaN, from known ones within so many pixels."""
    from rasterio.fill import fillnodata

    known = np.isfinite(heights)
    if not known.any():
        return heights
    filled = fillnodata(np.nan_to_num(heights), known.astype(np.uint8), reach, SMOOTHINGS)
    found = fillnodata(known.astype(np.float32), known.astype(np.uint8), reach)
    return np.where(found > 0.0, filled, np.float32(np.nan)).astype(np.float32)


def _enlarge(cells: NDArray[Any], step: int, size: tuple[int, int]) -> NDArray[np.float32]:
    """Return cells as pixels (H, W) of a size (W, H), interpolated between the middles of cells."""
    whole = cells.shape[1] * step, cells.shape[0] * step
    pixels = cv2.resize(cells.astype(np.float32), whole, interpolation=cv2.INTER_LINEAR)
    return np.asarray(pixels[: size[1], : size[0]], np.float32)
