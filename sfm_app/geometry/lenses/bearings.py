"""From pixels to bearing vectors through any lens, and back.

The projections are those of COLMAP's models: perspective with one radial term, OPENCV_FISHEYE (Kannala and Brandt
2006), and EQUIRECTANGULAR. Cameras that the user gave may have all terms of FULL_OPENCV and THIN_PRISM_FISHEYE.
"""

import numpy as np
from numpy.typing import NDArray

from sfm_app.geometry.camera import rays
from sfm_app.geometry.lenses.camera_models import distortion_terms
from sfm_app.geometry.lenses.distortion import radial_factor, undistort
from sfm_app.types.calibration import EQUIRECTANGULAR, FISHEYE, PERSPECTIVE, Calibration

FloatArray = NDArray[np.float64]

RAY, SLOPES = slice(0, 3), slice(3, 9)
"""Columns of `bearings`. By definition."""
BEARING = 9
"""Number of these columns. Counted."""
NEWTON_STEPS, LEAST_SLOPE = 20, 0.05
"""Steps of Newton's method for the angle, and the least slope of the radius: below it, the lens is near its fold.
Chosen by hand; not measured on their own."""
ANGLES = 512
"""Angles at which the fold of a fisheye lens is sought. Chosen by hand; not measured on its own."""


def bearings(x: FloatArray, camera: Calibration) -> FloatArray:
    """Return (N, 9) bearing vectors of pixels and their derivatives: ray, ray by x, ray by y.

    Rays of a perspective camera end on the plane z = 1, and their derivatives leave out the distortion; others have
    length 1.

    Args:
        x: (N, 2) pixels.
        camera: any projection.
    """
    found = np.zeros((len(x), BEARING))
    if camera.projection == EQUIRECTANGULAR:
        return _panorama_bearings(np.asarray(x, np.float64), camera, found)
    if camera.projection == FISHEYE:
        return _fisheye_bearings(_remove_shift(np.asarray(x, np.float64), camera), camera, found)
    found[:, :2], found[:, 2] = plane_points(x, camera), 1.0
    found[:, 3], found[:, 7] = 1.0 / camera.K[0, 0], 1.0 / camera.K[1, 1]
    return found


def plane_points(x: FloatArray, camera: Calibration) -> FloatArray:
    """Return (N, 2) points of the plane z = 1 that pixels of a perspective camera see.

    Args:
        x: (N, 2) pixels.
        camera: with the projection "perspective".
    """
    if camera.distortion:
        about = (np.asarray(x, np.float64) - camera.K[:2, 2]) / np.diag(camera.K)[:2]
        return undistort(about, distortion_terms(camera), PERSPECTIVE)
    return rays(x, camera.K, camera.radial)


def project(points: FloatArray, camera: Calibration) -> FloatArray:
    """Return (N, 2) pixels of points in the camera's frame; NaN where it cannot see them.

    Distortion of a perspective lens is left out.

    Args:
        points: (N, 3).
        camera: any projection.
    """
    if camera.projection == EQUIRECTANGULAR:
        level = np.hypot(points[:, 0], points[:, 2])
        turns = np.column_stack([np.arctan2(points[:, 0], points[:, 2]), np.arctan2(points[:, 1], level)])
        return np.asarray((turns / np.pi + [1.0, 0.5]) * [0.5 * camera.width, camera.height], np.float64)
    if camera.projection == FISHEYE:
        side = np.hypot(points[:, 0], points[:, 1])
        theta = np.arctan2(side, points[:, 2])
        radius = np.where(theta <= fold_angle(camera), fisheye_radius(theta, camera), np.nan)
        plain = points[:, :2] * np.divide(radius, side, out=np.zeros_like(side), where=side > 0.0)[:, None]
        return np.asarray(plain * np.diag(camera.K)[:2] + camera.K[:2, 2], np.float64)
    with np.errstate(invalid="ignore", divide="ignore"):
        x = (points @ camera.K.T)[:, :2] / points[:, 2:]
    return np.where(points[:, 2:] > 0.0, x, np.nan)


def depths_along(points: FloatArray, camera: Calibration) -> FloatArray:
    """Return (N,) depths: the factor from the ray of `bearings` to a point that it meets.

    Args:
        points: (N, 3) in the camera's frame.
        camera: any projection.
    """
    if camera.projection in {EQUIRECTANGULAR, FISHEYE}:
        return np.asarray(np.linalg.norm(points, axis=1), np.float64)
    return np.asarray(points[:, 2], np.float64)


def pixels_per_radian(lines: FloatArray) -> float:
    """Return the scale at the middle of the photo, as the focal states it for a perspective camera.

    Args:
        lines: (N, 9) from `bearings`, N > 0.
    """
    lengths = np.linalg.norm(lines[:, SLOPES].reshape(-1, 3), axis=1)
    return float(np.mean(1.0 / lengths))


def fisheye_radius(theta: FloatArray, camera: Calibration) -> FloatArray:
    """Return the radius (N,), in focal lengths, of rays at angles (N,) to the optical axis.

    Args:
        theta: radians, >= 0.
        camera: with the projection "fisheye".
    """
    return np.asarray(theta * _polynomial(theta, camera.fisheye), np.float64)


def fold_angle(camera: Calibration) -> float:
    """Return the largest angle in radians up to which the radius of a fisheye lens grows, at most pi.

    Args:
        camera: with the projection "fisheye".
    """
    theta = np.linspace(0.0, np.pi, ANGLES)
    folds = np.flatnonzero(_slope(theta, camera.fisheye) < LEAST_SLOPE)
    return float(theta[folds[0]]) if len(folds) else float(np.pi)


def _remove_shift(x: FloatArray, camera: Calibration) -> FloatArray:
    """Return (N, 2) where pixels of a fisheye would lie with its radial terms alone."""
    if not camera.distortion:
        return x
    terms, focals, center = distortion_terms(camera), np.diag(camera.K)[:2], camera.K[:2, 2]
    w = undistort((x - center) / focals, terms, FISHEYE)
    return np.asarray(w * radial_factor(np.hypot(*w.T), terms, FISHEYE)[:, None] * focals + center, np.float64)


def _fisheye_bearings(x: FloatArray, camera: Calibration, found: FloatArray) -> FloatArray:
    focals = np.diag(camera.K)[:2]
    about = (x - camera.K[:2, 2]) / focals
    radius, fold = np.hypot(about[:, 0], about[:, 1]), fold_angle(camera)
    theta = np.minimum(radius, fold)
    for _ in range(NEWTON_STEPS):
        slope = np.maximum(_slope(theta, camera.fisheye), LEAST_SLOPE)
        theta = np.clip(theta - (fisheye_radius(theta, camera) - radius) / slope, 0.0, fold)
    far = radius > 0.0
    out = np.divide(about, radius[:, None], out=np.tile([1.0, 0.0], (len(x), 1)), where=far[:, None])
    around = np.column_stack([-out[:, 1], out[:, 0]])
    sine, cosine = np.sin(theta), np.cos(theta)
    found[:, :2], found[:, 2] = out * sine[:, None], cosine
    outwards = 1.0 / np.maximum(_slope(theta, camera.fisheye), LEAST_SLOPE)
    sideways = np.divide(sine, radius, out=np.ones_like(radius), where=far)
    for axis in (0, 1):
        columns = slice(3 + 3 * axis, 5 + 3 * axis)
        radial, turning = outwards * out[:, axis], sideways * around[:, axis]
        found[:, columns] = out * (radial * cosine)[:, None] + around * turning[:, None]
        found[:, 5 + 3 * axis] = -radial * sine
    found[:, 3:6] /= focals[0]
    found[:, 6:9] /= focals[1]
    return found


def _panorama_bearings(x: FloatArray, camera: Calibration, found: FloatArray) -> FloatArray:
    by_x, by_y = 2.0 * np.pi / camera.width, np.pi / camera.height
    longitude, latitude = (x[:, 0] - 0.5 * camera.width) * by_x, (x[:, 1] - 0.5 * camera.height) * by_y
    east, north, level = np.sin(longitude), np.cos(longitude), np.cos(latitude)
    found[:, 0], found[:, 1], found[:, 2] = level * east, np.sin(latitude), level * north
    found[:, 3], found[:, 5] = by_x * level * north, -by_x * level * east
    found[:, 6], found[:, 8] = -by_y * np.sin(latitude) * east, -by_y * np.sin(latitude) * north
    found[:, 7] = by_y * level
    return found


def _polynomial(theta: FloatArray, terms: tuple[float, ...]) -> FloatArray:
    value, square = np.zeros_like(theta), theta * theta
    for term in reversed(terms):
        value = (value + term) * square
    return 1.0 + value


def _slope(theta: FloatArray, terms: tuple[float, ...]) -> FloatArray:
    return _polynomial(theta, tuple((2.0 * k + 3.0) * term for k, term in enumerate(terms)))
