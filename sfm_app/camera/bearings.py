"""Calibrations through any lens: bearing vectors of pixels, pixels of points, curve and field of view."""

import numpy as np

from sfm_app.camera.models import FAMILIES, row_of_calibration
from sfm_app.camera.projection import OPTIONS, RAY, SLOPES, fold_radius, image_points, image_rays, lens_terms, radius_at
from sfm_app.camera.rows import K1, P1, P2, SX, SY
from sfm_app.types.arrays import FloatArray
from sfm_app.types.camera import EQUIRECTANGULAR, FISHEYE, PERSPECTIVE, Calibration


def bearings(x: FloatArray, camera: Calibration) -> FloatArray:
    """Return bearing vectors (N, 9) of pixels (N, 2): ray, derivative of the ray by x, and by y.

    Rays of a perspective camera end on the plane z = 1, and their derivatives leave out the distortion; others have
    length 1.
    """
    lines = image_rays(x, row_of_calibration(camera), FAMILIES[camera.projection])
    if camera.projection == PERSPECTIVE:
        lines[:, SLOPES] = 0.0
        lines[:, 3], lines[:, 7] = 1.0 / camera.K[0, 0], 1.0 / camera.K[1, 1]
    return lines


def project(points: FloatArray, camera: Calibration) -> FloatArray:
    """Return pixels (N, 2) of points (N, 3) in the camera's frame; NaN where it cannot see them.

    Distortion of a perspective lens is left out, and terms of a fisheye that are not radial.
    """
    params, family = row_of_calibration(camera), FAMILIES[camera.projection]
    params[[P1, P2, SX, SY] if camera.projection == FISHEYE else slice(K1, None)] = 0.0
    x = image_points(points, params, family)
    if camera.projection == EQUIRECTANGULAR:
        return x
    if camera.projection == PERSPECTIVE:
        return np.where(points[:, 2:] > 0.0, x, np.nan)
    theta = np.arctan2(np.hypot(points[:, 0], points[:, 1]), points[:, 2])
    return np.where((theta <= fold_radius(lens_terms(params), family, OPTIONS.least_slope))[:, None], x, np.nan)


def depths_along(points: FloatArray, camera: Calibration) -> FloatArray:
    """Return depths (N,) of points (N, 3) in the camera's frame: their factors along the rays of `bearings`."""
    if camera.projection in {EQUIRECTANGULAR, FISHEYE}:
        return np.asarray(np.linalg.norm(points, axis=1), np.float64)
    return np.asarray(points[:, 2], np.float64)


# The curve of a lens: the radius in the photo over the angle to the optical axis, and the field of view.
# The curve counts from the optical center, with the geometric mean of both focals and radial terms only.

SHARES = (0.25, 0.5, 0.75, 1.0)
"""Shares of the corner's angle with the deviation of the radius, in the evidence of a wide lens. Chosen by hand."""


def radius_px(theta: FloatArray, camera: Calibration) -> FloatArray:
    """Return radii (N,) in pixels of rays at angles (N,) in radians to the axis; NaN beyond what the lens shows."""
    if camera.projection == EQUIRECTANGULAR:
        return np.asarray(theta * camera.width / (2.0 * np.pi), np.float64)
    params, family = row_of_calibration(camera), FAMILIES[camera.projection]
    fold = fold_radius(lens_terms(params), family, OPTIONS.least_slope)
    limit = fold if camera.projection == FISHEYE else np.arctan(fold)
    return np.where(theta <= limit, camera.focal_px * radius_at(np.minimum(theta, limit), params, family), np.nan)


def radius_deviation_px(theta: FloatArray, camera: Calibration) -> FloatArray:
    """Return standard deviations (N,) of `radius_px` at angles (N,) in radians, as far as they are known.

    They come from the evidence of a wide lens, else from the deviations of the focal and of k1 as if independent.
    """
    stated = [camera.evidence.get(deviation_key(share)) for share in SHARES]
    values = [value for value in stated if value is not None]
    if len(values) == len(SHARES):
        return np.interp(theta / corner_angle(camera), (0.0, *SHARES), (0.0, *values))
    focal = camera.spread.get("fx", 0.0) / camera.K[0, 0]
    variance = np.square(np.nan_to_num(radius_px(theta, camera)) * focal)
    if camera.projection == PERSPECTIVE and "k1" in camera.spread:
        variance += np.square(camera.focal_px * np.tan(np.minimum(theta, 1.5)) ** 3 * camera.spread["k1"])
    return np.asarray(np.sqrt(variance), np.float64)


def deviation_key(share: float) -> str:
    """Return the key in `Calibration.evidence` of the deviation of the radius at a share of the corner's angle."""
    return f"radius_deviation_px at {100 * share:.0f} % of the field"


def corner_angle(camera: Calibration) -> float:
    """Return the angle in radians between the optical axis and the farthest corner that the lens shows."""
    corners = np.array([[x, y] for x in (0.0, camera.width) for y in (0.0, camera.height)], np.float64)
    return float(np.max(_angles(corners, camera)))


def field_of_view_deg(camera: Calibration) -> tuple[float, float]:
    """Return the horizontal and the vertical field of view in degrees, along the lines through the optical center."""
    if camera.projection == EQUIRECTANGULAR:
        return 360.0, 180.0
    cx, cy = camera.K[:2, 2]
    ends = np.array([[0.0, cy], [camera.width, cy], [cx, 0.0], [cx, camera.height]], np.float64)
    # an optical center outside of the photo sees both ends on one side
    sides = np.array([cx, camera.width - cx, cy, camera.height - cy])
    angles = np.degrees(_angles(ends, camera)) * np.where(sides < 0.0, -1.0, 1.0)
    return float(angles[0] + angles[1]), float(angles[2] + angles[3])


def _angles(x: FloatArray, camera: Calibration) -> FloatArray:
    """Return (N,) angles in radians between pixels and the optical axis."""
    rays = bearings(x, camera)[:, RAY]
    return np.asarray(np.arctan2(np.hypot(rays[:, 0], rays[:, 1]), rays[:, 2]), np.float64)
