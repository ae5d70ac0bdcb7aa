"""What lies between known pixels, and not beyond them: depths may be interpolated, but not extrapolated.

A sky of the color of the wall beside it, and a plain wall of which little is known, look alike but for this.
"""

import cv2
import numpy as np
from numpy.typing import NDArray

CLOSE_PX, LEAST_SHARE = 9, 0.1
"""Side of a square, and the share of it that has to be known, so that chance counts nothing. Chosen by hand."""
MIN_SIDES = 3
"""Of the four sides of a pixel, those on which something has to be known. Chosen on `garden` and `ornament`."""


def enclosed_pixels(known: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Mark pixels (H, W) with known ones on at least three of their four sides, at any distance.

    Args:
        known: (H, W).
    """
    around = (cv2.blur(known.astype(np.float32), (CLOSE_PX, CLOSE_PX)) >= LEAST_SHARE).view(np.uint8)
    sides = np.zeros(known.shape, np.uint8)
    for axis in (0, 1):
        sides += np.maximum.accumulate(around, axis=axis)
        sides += np.flip(np.maximum.accumulate(np.flip(around, axis), axis=axis), axis)
    return np.asarray(sides >= MIN_SIDES)
