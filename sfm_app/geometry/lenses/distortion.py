"""Lenses with all terms of COLMAP's FULL_OPENCV and THIN_PRISM_FISHEYE: from distorted points to undistorted ones.

A point w of the plane before distortion, in focal lengths, is x / z of a perspective lens; of a fisheye it has the
length theta. It becomes w times a radial factor of |w|, plus tangential terms (Brown 1971) and those of a thin prism
(Weng et al. 1992).
"""

import numpy as np
from numpy.typing import NDArray

from sfm_app.types.calibration import FISHEYE

FloatArray = NDArray[np.float64]

NEWTON_STEPS, LEAST_SLOPE = 30, 0.05
"""Most steps of Newton's method for the radius, and the least slope of the distorted radius: below it the lens is near
its fold. Chosen by hand; not measured on their own."""
SHIFT_STEPS, PRECISION = 50, 1e-13
"""Most steps by which the terms that are not radial are taken out, and the change below which these and Newton's steps
end, in focal lengths. Counted: each step multiplies the error by about twice the radius times p1, 0.01 at most."""
LARGEST_RADIUS, RADII = 12.0, 2048
"""Radius up to which a fold is sought, in focal lengths, and number of radii: 85 degrees of a perspective lens, and
more than any fisheye. Chosen by hand; not measured on their own."""


def radial_factor(r: FloatArray, terms: FloatArray, projection: str) -> FloatArray:
    """Return (N,) the distorted over the undistorted radius.

    Args:
        r: (N,) undistorted radius in focal lengths; for a fisheye the angle to the axis.
        terms: (8,) as in `Calibration.distortion`.
        projection: "perspective" or "fisheye".
    """
    k1, k2, _, _, k3, k4, k5, k6 = terms
    s = r * r
    if projection == FISHEYE:
        return np.asarray(1.0 + s * (k1 + s * (k2 + s * (k3 + s * k4))))
    return np.asarray((1.0 + s * (k1 + s * (k2 + s * k3))) / (1.0 + s * (k4 + s * (k5 + s * k6))))


def fold_radius(terms: FloatArray, projection: str) -> float:
    """Return the undistorted radius up to which the distorted one grows, at most `LARGEST_RADIUS`; pi for a fisheye.

    Args:
        terms, projection: as in `radial_factor`.
    """
    r = np.linspace(0.0, np.pi if projection == FISHEYE else LARGEST_RADIUS, RADII)
    with np.errstate(all="ignore"):
        slopes = np.diff(r * radial_factor(r, terms, projection)) / (r[1] - r[0])
    ends = np.flatnonzero(~(slopes >= LEAST_SLOPE))
    return float(r[ends[0]] if len(ends) else r[-1])


def undistort(points: FloatArray, terms: FloatArray, projection: str) -> FloatArray:
    """Return (N, 2) points of the plane before distortion; those beyond the fold of the lens lie on it.

    Args:
        points: (N, 2) in focal lengths from the optical center.
        terms, projection: as in `radial_factor`.
    """
    fold = fold_radius(terms, projection)
    w = _undistort_radius(points, terms, projection, fold)
    if not _shift(w, terms, projection).any():
        return w
    for _ in range(SHIFT_STEPS):
        before, w = w, _undistort_radius(points - _shift(w, terms, projection), terms, projection, fold)
        if np.max(np.abs(w - before), initial=0.0) < PRECISION:
            break
    return w


def _undistort_radius(points: FloatArray, terms: FloatArray, projection: str, fold: float) -> FloatArray:
    """Return (N, 2) points before the radial distortion alone, by Newton's method that bisection keeps in bounds."""
    distorted = np.hypot(points[:, 0], points[:, 1])
    low, high = np.zeros_like(distorted), np.full_like(distorted, fold)
    r = np.minimum(distorted, fold)
    step = 1e-6
    for _ in range(NEWTON_STEPS):
        error = r * radial_factor(r, terms, projection) - distorted
        low, high = np.where(error < 0.0, r, low), np.where(error > 0.0, r, high)
        ahead = (r + step) * radial_factor(r + step, terms, projection) - distorted
        tried = r - error / np.maximum((ahead - error) / step, LEAST_SLOPE)
        before, r = r, np.where((tried >= low) & (tried <= high), tried, 0.5 * (low + high))
        if np.max(np.abs(r - before), initial=0.0) < PRECISION:
            break
    return np.asarray(points * np.divide(r, distorted, out=np.ones_like(r), where=distorted > 0.0)[:, None])


def _shift(w: FloatArray, terms: FloatArray, projection: str) -> FloatArray:
    """Return (N, 2) what the terms that are not radial add."""
    _, _, p1, p2, _, _, sx, sy = terms
    x, y = w.T
    square = x * x + y * y
    shift = np.column_stack(
        [2.0 * p1 * x * y + p2 * (square + 2.0 * x * x), p1 * (square + 2.0 * y * y) + 2.0 * p2 * x * y]
    )
    return np.asarray(shift + square[:, None] * [sx, sy] if projection == FISHEYE else shift)
