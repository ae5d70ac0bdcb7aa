"""Photos sampled at other positions, such as those of a perspective view."""

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

SEAM_PX = 4
"""Columns of the other border that are added at either one, for interpolation. Chosen by hand; not measured on its
own."""


def resample(
    photo: NDArray[np.uint8], at: NDArray[np.floating[Any]], size: tuple[int, int], wraps: bool = False
) -> NDArray[np.uint8]:
    """Return a photo (H, W, 3) at given positions, by cubic interpolation; beyond its border, the border is repeated.

    Args:
        photo: (h, w, 3), perhaps scaled down.
        at: (H, W, 2) pixels of the photo in its own size; centers at +0.5.
        size: (width, height) of the photo in its own size.
        wraps: whether its left and right border are the same place, as those of a panorama.
    """
    height, width = photo.shape[:2]
    x, y = (
        np.ascontiguousarray(at[..., axis] * (side / size[axis]) - 0.5, np.float32)
        for axis, side in enumerate((width, height))
    )
    if wraps:
        photo = cv2.copyMakeBorder(photo, 0, 0, SEAM_PX, SEAM_PX, cv2.BORDER_WRAP)
        x += SEAM_PX
    return np.asarray(cv2.remap(photo, x, y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE), np.uint8)


def shrink(photo: NDArray[np.uint8], share: float) -> NDArray[np.uint8]:
    """Return a photo (h, w, 3) scaled down by averaging, so that sampling it does not alias.

    Args:
        photo: (H, W, 3).
        share: of its size; with 1 or more it stays as it is.
    """
    if share >= 1.0:
        return photo
    size = max(1, round(photo.shape[1] * share)), max(1, round(photo.shape[0] * share))
    return np.asarray(cv2.resize(photo, size, interpolation=cv2.INTER_AREA), np.uint8)
