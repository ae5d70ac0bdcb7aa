"""The curve of a lens: the radius in the photo over the angle to the optical axis, and the field that follows from it.

The curve counts from the optical center, with the geometric mean of both focals, and without terms that are not radial.
"""

import numpy as np
from numpy.typing import NDArray

from sfm_app.geometry.lenses.bearings import RAY, bearings, fisheye_radius, fold_angle
from sfm_app.geometry.lenses.camera_models import distortion_terms
from sfm_app.geometry.lenses.distortion import fold_radius, radial_factor
from sfm_app.types.calibration import EQUIRECTANGULAR, FISHEYE, PERSPECTIVE, Calibration

FloatArray = NDArray[np.float64]

SHARES = (0.25, 0.5, 0.75, 1.0)
"""Shares of the angle of the farthest corner at which the evidence of a wide lens states the deviation of the radius.
Chosen by hand: the deviation is smooth."""


def radius_px(theta: FloatArray, camera: Calibration) -> FloatArray:
    """Return (N,) radii in pixels of rays at angles (N,) to the optical axis; NaN where the lens does not show them.

    Args:
        theta: radians, >= 0.
        camera: any projection; of a panorama the curve along its horizon is meant.
    """
    if camera.projection == EQUIRECTANGULAR:
        return np.asarray(theta * camera.width / (2.0 * np.pi), np.float64)
    if camera.projection == FISHEYE:
        return np.where(theta <= fold_angle(camera), camera.focal_px * fisheye_radius(theta, camera), np.nan)
    terms = distortion_terms(camera)
    ahead = theta < 0.5 * np.pi
    r = np.tan(np.where(ahead, theta, 0.0))
    shown = ahead & (r <= fold_radius(terms, PERSPECTIVE))
    with np.errstate(over="ignore", invalid="ignore"):
        return np.where(shown, camera.focal_px * r * radial_factor(r, terms, PERSPECTIVE), np.nan)


def radius_deviation_px(theta: FloatArray, camera: Calibration) -> FloatArray:
    """Return (N,) standard deviations of `radius_px`, as far as they are known.

    They come from the evidence of a wide lens, else from the deviations of the focal and of k1 as if independent.

    Args:
        theta: radians, >= 0.
        camera: any projection.
    """
    stated = [camera.evidence.get(deviation_key(share)) for share in SHARES]
    values = [value for value in stated if value is not None]
    if len(values) == len(SHARES):
        return np.interp(theta / corner_angle(camera), (0.0, *SHARES), (0.0, *values))
    focal = camera.spread.get("fx", 0.0) / camera.K[0, 0]
    found = np.square(np.nan_to_num(radius_px(theta, camera)) * focal)
    if camera.projection == PERSPECTIVE and "k1" in camera.spread:
        found += np.square(camera.focal_px * np.tan(np.minimum(theta, 1.5)) ** 3 * camera.spread["k1"])
    return np.asarray(np.sqrt(found), np.float64)


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
