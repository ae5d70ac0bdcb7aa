"""The pixels of a sky, given its cells: up to the outlines of what stands before it."""

import cv2
import numpy as np
from numpy.typing import NDArray

from sfm_app.stereo.view import GrayImage

REACH = 0.02
"""How far beyond its cells a sky is looked for, in longer sides of the photo: as far as semi-global matching carries
depths on. Chosen on `garden` and `ornament`."""
TOLERANCE = 4.0
"""Largest difference in gray levels from the sky around, after noise is smoothed. Chosen on `railing`, where 4 marks
88 % of the sky and 0.04 % of what is not, and 5 gains a hundredth."""
LEAST_WEIGHT = 1e-4
"""Of the sky around that is averaged. By definition: rounding."""


def sky_pixels(photo: GrayImage, cells: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Mark the pixels (H, W) of the sky: near its cells, and of the gray level that the sky has there.

    Args:
        photo: (H, W).
        cells: (h, w) cells of the sky.
    """
    if not cells.any():
        return np.zeros(photo.shape, bool)
    shape, reach = photo.shape[::-1], REACH * max(cells.shape)
    sky, side = cells.astype(np.float32), 2 * round(reach) + 1
    gray = cv2.resize(photo, cells.shape[::-1], interpolation=cv2.INTER_AREA)
    weight = cv2.GaussianBlur(sky, (0, 0), reach)
    around = cv2.GaussianBlur(sky * gray, (0, 0), reach) / np.maximum(weight, LEAST_WEIGHT)
    near = cv2.resize(cv2.dilate(sky, np.ones((side, side), np.uint8)), shape, interpolation=cv2.INTER_NEAREST) > 0
    smooth = cv2.GaussianBlur(photo.astype(np.float32), (3, 3), 0)  # a median would swallow wires
    differs = np.abs(smooth - cv2.resize(around, shape))
    return np.asarray(near & (differs <= TOLERANCE))
