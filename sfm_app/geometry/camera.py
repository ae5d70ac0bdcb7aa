"""Camera matrices."""

import numpy as np
from numpy.typing import NDArray

GUESSED_FOCAL = 1.2
"""Focal of a camera about which nothing is known, in units of the longer side; COLMAP guesses the same."""


def camera_matrix(fx: float, fy: float, cx: float, cy: float) -> NDArray[np.float64]:
    """(3, 3) camera matrix without skew, in the unit of its arguments."""
    return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])


def guessed_camera_matrix(size: tuple[int, int], focal_px: float | None = None) -> NDArray[np.float64]:
    """(3, 3): square pixels, the optical centre in the middle, and the given focal or the usual guess.

    Args:
        size: (width, height) in pixels.
        focal_px: 1.2 times the longer side where None.
    """
    focal = GUESSED_FOCAL * max(size) if focal_px is None else focal_px
    return camera_matrix(focal, focal, size[0] / 2, size[1] / 2)
