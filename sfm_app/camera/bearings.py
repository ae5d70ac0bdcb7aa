"""From pixels to bearing vectors through any lens and back; undistortion; the curve and the field of view of a lens.

The projections are those of COLMAP's models: perspective with one radial term, OPENCV_FISHEYE (Kannala and Brandt
2006), and EQUIRECTANGULAR. Cameras that the user gave may have all terms of FULL_OPENCV and THIN_PRISM_FISHEYE.
"""

from dataclasses import dataclass

import numpy as np

from sfm_app.camera.models import distortion_terms, rays
from sfm_app.types.arrays import FloatArray
from sfm_app.types.camera import EQUIRECTANGULAR, FISHEYE, PERSPECTIVE, Calibration

# Undistortion of lenses with all terms.
# A point w of the plane before distortion, in focal lengths, is x / z of a perspective lens; of a fisheye it has
# the length theta. It becomes w times a radial factor of |w|, plus tangential terms (Brown 1971) and those of a
# thin prism (Weng et al. 1992).


@dataclass(frozen=True, slots=True)
class UndistortionOptions:
    """Limits of undistortion."""

    radius_steps: int = 30
    """Most steps of Newton's method for the radius. Chosen by hand."""
    shift_steps: int = 50
    """Most steps for the terms that are not radial. Counted: each multiplies the error by 0.01 at most."""
    precision: float = 1e-13
    """Change in focal lengths below which steps end. Chosen by hand."""
    least_slope: float = 0.05
    """Least slope of the distorted radius: below it, the lens is near its fold. Chosen by hand."""
    largest_radius: float = 12.0
    """Radius in focal lengths up to which a fold is sought: 85 degrees of a perspective lens. Chosen by hand."""
    radii: int = 2048
    """Number of radii at which a fold is sought. Chosen by hand."""
    angle_steps: int = 20
    """Steps of Newton's method for the angle of a fisheye. Chosen by hand."""
    angles: int = 512
    """Number of angles at which the fold of a fisheye is sought. Chosen by hand."""


OPTIONS = UndistortionOptions()


def radial_factor(r: FloatArray, terms: FloatArray, projection: str) -> FloatArray:
    """Return (N,) ratios of the distorted to the undistorted radius in focal lengths; of a fisheye, to the angle."""
    k1, k2, _, _, k3, k4, k5, k6 = terms
    s = r * r
    if projection == FISHEYE:
        return np.asarray(1.0 + s * (k1 + s * (k2 + s * (k3 + s * k4))))
    return np.asarray((1.0 + s * (k1 + s * (k2 + s * k3))) / (1.0 + s * (k4 + s * (k5 + s * k6))))


def fold_radius(terms: FloatArray, projection: str) -> float:
    """Return the undistorted radius up to which the distorted one grows, at most `largest_radius`; pi for a fisheye."""
    r = np.linspace(0.0, np.pi if projection == FISHEYE else OPTIONS.largest_radius, OPTIONS.radii)
    with np.errstate(all="ignore"):
        slopes = np.diff(r * radial_factor(r, terms, projection)) / (r[1] - r[0])
    ends = np.flatnonzero(~(slopes >= OPTIONS.least_slope))
    return float(r[ends[0]] if len(ends) else r[-1])


def undistort(points: FloatArray, terms: FloatArray, projection: str) -> FloatArray:
    """Return points (N, 2) before distortion, in focal lengths from the center; those beyond the fold lie on it."""
    fold = fold_radius(terms, projection)
    w = _undistort_radius(points, terms, projection, fold)
    if not _shift(w, terms, projection).any():
        return w
    for _ in range(OPTIONS.shift_steps):
        before, w = w, _undistort_radius(points - _shift(w, terms, projection), terms, projection, fold)
        if np.max(np.abs(w - before), initial=0.0) < OPTIONS.precision:
            break
    return w


def _undistort_radius(points: FloatArray, terms: FloatArray, projection: str, fold: float) -> FloatArray:
    """Return points (N, 2) before the radial distortion alone, by Newton's method within bounds of a bisection."""
    distorted = np.hypot(points[:, 0], points[:, 1])
    low, high = np.zeros_like(distorted), np.full_like(distorted, fold)
    r = np.minimum(distorted, fold)
    step = 1e-6
    for _ in range(OPTIONS.radius_steps):
        error = r * radial_factor(r, terms, projection) - distorted
        low, high = np.where(error < 0.0, r, low), np.where(error > 0.0, r, high)
        ahead = (r + step) * radial_factor(r + step, terms, projection) - distorted
        guess = r - error / np.maximum((ahead - error) / step, OPTIONS.least_slope)
        before, r = r, np.where((guess >= low) & (guess <= high), guess, 0.5 * (low + high))
        if np.max(np.abs(r - before), initial=0.0) < OPTIONS.precision:
            break
    return np.asarray(points * np.divide(r, distorted, out=np.ones_like(r), where=distorted > 0.0)[:, None])


def _shift(w: FloatArray, terms: FloatArray, projection: str) -> FloatArray:
    """Return shifts (N, 2) by the terms that are not radial."""
    _, _, p1, p2, _, _, sx, sy = terms
    x, y = w.T
    square = x * x + y * y
    shift = np.column_stack(
        [2.0 * p1 * x * y + p2 * (square + 2.0 * x * x), p1 * (square + 2.0 * y * y) + 2.0 * p2 * x * y]
    )
    return np.asarray(shift + square[:, None] * [sx, sy] if projection == FISHEYE else shift)


# Bearing vectors.

RAY, SLOPES = slice(0, 3), slice(3, 9)
"""Columns of `bearings`. By definition."""
BEARING = 9
"""Number of these columns. Counted."""


def bearings(x: FloatArray, camera: Calibration) -> FloatArray:
    """Return bearing vectors (N, 9) of pixels (N, 2): ray, derivative of the ray by x, and by y.

    Rays of a perspective camera end on the plane z = 1, and their derivatives leave out the distortion; others have
    length 1.
    """
    if camera.projection == EQUIRECTANGULAR:
        return _panorama_bearings(np.asarray(x, np.float64), camera)
    if camera.projection == FISHEYE:
        return _fisheye_bearings(_remove_shift(np.asarray(x, np.float64), camera), camera)
    lines = np.zeros((len(x), BEARING))
    lines[:, :2], lines[:, 2] = plane_points(x, camera), 1.0
    lines[:, 3], lines[:, 7] = 1.0 / camera.K[0, 0], 1.0 / camera.K[1, 1]
    return lines


def plane_points(x: FloatArray, camera: Calibration) -> FloatArray:
    """Return points (N, 2) of the plane z = 1 that pixels (N, 2) of a perspective camera see."""
    if camera.distortion:
        w = (np.asarray(x, np.float64) - camera.K[:2, 2]) / np.diag(camera.K)[:2]
        return undistort(w, distortion_terms(camera), PERSPECTIVE)
    return rays(x, camera.K, camera.radial)


def project(points: FloatArray, camera: Calibration) -> FloatArray:
    """Return pixels (N, 2) of points (N, 3) in the camera's frame; NaN where it cannot see them.

    Distortion of a perspective lens is left out.
    """
    if camera.projection == EQUIRECTANGULAR:
        level = np.hypot(points[:, 0], points[:, 2])
        angles = np.column_stack([np.arctan2(points[:, 0], points[:, 2]), np.arctan2(points[:, 1], level)])
        return np.asarray((angles / np.pi + [1.0, 0.5]) * [0.5 * camera.width, camera.height], np.float64)
    if camera.projection == FISHEYE:
        side = np.hypot(points[:, 0], points[:, 1])
        theta = np.arctan2(side, points[:, 2])
        radius = np.where(theta <= fold_angle(camera), fisheye_radius(theta, camera), np.nan)
        w = points[:, :2] * np.divide(radius, side, out=np.zeros_like(side), where=side > 0.0)[:, None]
        return np.asarray(w * np.diag(camera.K)[:2] + camera.K[:2, 2], np.float64)
    with np.errstate(invalid="ignore", divide="ignore"):
        x = (points @ camera.K.T)[:, :2] / points[:, 2:]
    return np.where(points[:, 2:] > 0.0, x, np.nan)


def depths_along(points: FloatArray, camera: Calibration) -> FloatArray:
    """Return depths (N,) of points (N, 3) in the camera's frame: their factors along the rays of `bearings`."""
    if camera.projection in {EQUIRECTANGULAR, FISHEYE}:
        return np.asarray(np.linalg.norm(points, axis=1), np.float64)
    return np.asarray(points[:, 2], np.float64)


def pixels_per_radian(lines: FloatArray) -> float:
    """Return the scale at the center of the photo, the focal of a perspective camera, from `bearings` (N, 9), N > 0."""
    lengths = np.linalg.norm(lines[:, SLOPES].reshape(-1, 3), axis=1)
    return float(np.mean(1.0 / lengths))


def fisheye_radius(theta: FloatArray, camera: Calibration) -> FloatArray:
    """Return the radius (N,), in focal lengths, of rays at angles (N,) in radians to the axis of a fisheye."""
    return np.asarray(theta * _polynomial(theta, camera.fisheye), np.float64)


def fold_angle(camera: Calibration) -> float:
    """Return the largest angle in radians up to which the radius of a fisheye lens grows, at most pi."""
    theta = np.linspace(0.0, np.pi, OPTIONS.angles)
    folds = np.flatnonzero(_slope(theta, camera.fisheye) < OPTIONS.least_slope)
    return float(theta[folds[0]]) if len(folds) else float(np.pi)


def _remove_shift(x: FloatArray, camera: Calibration) -> FloatArray:
    """Return pixels (N, 2) of a fisheye as its radial terms alone would show them."""
    if not camera.distortion:
        return x
    terms, focals, center = distortion_terms(camera), np.diag(camera.K)[:2], camera.K[:2, 2]
    w = undistort((x - center) / focals, terms, FISHEYE)
    return np.asarray(w * radial_factor(np.hypot(*w.T), terms, FISHEYE)[:, None] * focals + center, np.float64)


def _fisheye_bearings(x: FloatArray, camera: Calibration) -> FloatArray:
    lines, focals = np.zeros((len(x), BEARING)), np.diag(camera.K)[:2]
    offsets = (x - camera.K[:2, 2]) / focals
    radius, fold = np.hypot(offsets[:, 0], offsets[:, 1]), fold_angle(camera)
    theta = np.minimum(radius, fold)
    for _ in range(OPTIONS.angle_steps):
        slope = np.maximum(_slope(theta, camera.fisheye), OPTIONS.least_slope)
        theta = np.clip(theta - (fisheye_radius(theta, camera) - radius) / slope, 0.0, fold)
    far = radius > 0.0
    outward = np.divide(offsets, radius[:, None], out=np.tile([1.0, 0.0], (len(x), 1)), where=far[:, None])
    tangent = np.column_stack([-outward[:, 1], outward[:, 0]])
    sine, cosine = np.sin(theta), np.cos(theta)
    lines[:, :2], lines[:, 2] = outward * sine[:, None], cosine
    radial_rate = 1.0 / np.maximum(_slope(theta, camera.fisheye), OPTIONS.least_slope)
    tangential_rate = np.divide(sine, radius, out=np.ones_like(radius), where=far)
    for axis in (0, 1):
        columns = slice(3 + 3 * axis, 5 + 3 * axis)
        radial, turning = radial_rate * outward[:, axis], tangential_rate * tangent[:, axis]
        lines[:, columns] = outward * (radial * cosine)[:, None] + tangent * turning[:, None]
        lines[:, 5 + 3 * axis] = -radial * sine
    lines[:, 3:6] /= focals[0]
    lines[:, 6:9] /= focals[1]
    return lines


def _panorama_bearings(x: FloatArray, camera: Calibration) -> FloatArray:
    lines = np.zeros((len(x), BEARING))
    by_x, by_y = 2.0 * np.pi / camera.width, np.pi / camera.height
    longitude, latitude = (x[:, 0] - 0.5 * camera.width) * by_x, (x[:, 1] - 0.5 * camera.height) * by_y
    east, north, level = np.sin(longitude), np.cos(longitude), np.cos(latitude)
    lines[:, 0], lines[:, 1], lines[:, 2] = level * east, np.sin(latitude), level * north
    lines[:, 3], lines[:, 5] = by_x * level * north, -by_x * level * east
    lines[:, 6], lines[:, 8] = -by_y * np.sin(latitude) * east, -by_y * np.sin(latitude) * north
    lines[:, 7] = by_y * level
    return lines


def _polynomial(theta: FloatArray, terms: tuple[float, ...]) -> FloatArray:
    value, square = np.zeros_like(theta), theta * theta
    for term in reversed(terms):
        value = (value + term) * square
    return 1.0 + value


def _slope(theta: FloatArray, terms: tuple[float, ...]) -> FloatArray:
    return _polynomial(theta, tuple((2.0 * k + 3.0) * term for k, term in enumerate(terms)))


# The curve of a lens: the radius in the photo over the angle to the optical axis, and the field of view.
# The curve counts from the optical center, with the geometric mean of both focals and radial terms only.

SHARES = (0.25, 0.5, 0.75, 1.0)
"""Shares of the corner's angle with the deviation of the radius, in the evidence of a wide lens. Chosen by hand."""


def radius_px(theta: FloatArray, camera: Calibration) -> FloatArray:
    """Return radii (N,) in pixels of rays at angles (N,) in radians to the axis; NaN where the lens does not show them.

    The curve of a panorama is that along its horizon.
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
