"""Camera matrices."""

import numpy as np
from numpy.typing import NDArray

GUESSED_FOCAL = 1.2
"""Focal of a camera about which nothing is known, in units of the longer side; COLMAP guesses the same."""

LEAST_SLOPE, NEWTON_STEPS = 0.2, 8


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


def rays(x: NDArray[np.float64], K: NDArray[np.float64], radial: float = 0.0) -> NDArray[np.float64]:
    """(N, 2) points of the plane z = 1 that pixels see through a lens x_d = x_u (1 + radial r_u^2).

    Newton's search from the distorted radius. Where a barrel lens squeezes radii by more than `LEAST_SLOPE` it takes
    short steps: no photo holds what lies beyond the fold.

    Args:
        x: (N, 2) pixels.
        K: (3, 3) camera matrix without skew.
        radial: k1 of COLMAP's SIMPLE_RADIAL.
    """
    distorted = (x - K[:2, 2]) / np.diag(K)[:2]
    if radial == 0.0:
        return np.asarray(distorted, np.float64)
    radius = np.hypot(distorted[:, 0], distorted[:, 1])
    r = radius / (1.0 + max(radial, 0.0) * radius**2)
    for _ in range(NEWTON_STEPS):
        r -= (r * (1.0 + radial * r * r) - radius) / np.maximum(1.0 + 3.0 * radial * r * r, LEAST_SLOPE)
    return np.asarray(distorted * np.divide(r, radius, out=np.ones_like(r), where=radius > 0)[:, None], np.float64)
