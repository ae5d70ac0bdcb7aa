"""Camera matrices."""

import numpy as np
from numpy.typing import NDArray

GUESSED_FOCAL = 1.2
"""Focal length of an unknown camera, in units of the longer side of its photo: COLMAP's guess, by definition."""

NEWTON_STEPS, LEAST_SLOPE = 10, 0.2
"""Steps of Newton's method in `rays`, and the least slope that it divides by: the slope is 0 where the lens folds.
Chosen by hand; halved and doubled by `benchmarks.sensitivity`."""


def camera_matrix(fx: float, fy: float, cx: float, cy: float) -> NDArray[np.float64]:
    """Return the (3, 3) camera matrix without skew, in the unit of its arguments.

    Args:
        fx: focal length along x.
        fy: focal length along y.
        cx: x of the principal point.
        cy: y of the principal point.
    """
    return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])


def guessed_camera_matrix(size: tuple[int, int], focal_px: float | None = None) -> NDArray[np.float64]:
    """Return the (3, 3) matrix of a camera with square pixels, a centered principal point and a given or guessed focal.

    Args:
        size: (width, height) in pixels.
        focal_px: focal length; 1.2 times the longer side if None.
    """
    focal = GUESSED_FOCAL * max(size) if focal_px is None else focal_px
    return camera_matrix(focal, focal, size[0] / 2, size[1] / 2)


def panorama_matrix(size: tuple[int, int]) -> NDArray[np.float64]:
    """Return the (3, 3) matrix that states the scale of an equirectangular photo at its middle, in pixels per radian.

    Args:
        size: (width, height) in pixels, of a whole turn and of half a turn.
    """
    return camera_matrix(size[0] / (2.0 * np.pi), size[1] / np.pi, size[0] / 2, size[1] / 2)


def rays(x: NDArray[np.float64], K: NDArray[np.float64], radial: float = 0.0) -> NDArray[np.float64]:
    """Undistort pixels to (N, 2) points of the plane z = 1, for a lens x_d = x_u (1 + radial r_u^2).

    Uses Newton's method from the distorted radius. A barrel lens folds where r (1 + radial r^2) stops growing with r;
    pixels beyond the fold are mapped to it.

    Args:
        x: (N, 2) pixels.
        K: (3, 3) camera matrix without skew.
        radial: k1 of COLMAP's SIMPLE_RADIAL.
    """
    distorted = (x - K[:2, 2]) / np.diag(K)[:2]
    if radial == 0.0:
        return np.asarray(distorted, np.float64)
    radius = np.hypot(distorted[:, 0], distorted[:, 1])
    fold = (-3.0 * radial) ** -0.5 if radial < 0.0 else np.inf
    r = np.minimum(radius / (1.0 + max(radial, 0.0) * radius**2), fold)
    for _ in range(NEWTON_STEPS):
        slope = np.maximum(1.0 + 3.0 * radial * r * r, LEAST_SLOPE)
        r = np.minimum(r - (r * (1.0 + radial * r * r) - radius) / slope, fold)
    return np.asarray(distorted * np.divide(r, radius, out=np.ones_like(r), where=radius > 0)[:, None], np.float64)
