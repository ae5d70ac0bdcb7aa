"""Projection and back-projection through all lenses, with their derivatives: the only place that knows them.

The cameras are those of COLMAP: perspective ones FULL_OPENCV (Brown 1971, with a rational radial factor), fisheyes
THIN_PRISM_FISHEYE (Kannala and Brandt 2006; Weng et al. 1992), panoramas EQUIRECTANGULAR. Smaller models of COLMAP are
these with zeros. A camera is a row (12,) of parameters in COLMAP's order, and a family.

A point w of the plane before distortion, in focal lengths, is x / z of a perspective lens; of a fisheye it has the
length theta. It becomes w times a radial factor of |w|, plus tangential terms and those of a thin prism.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from sfm_app.camera.rows import (
    CAMERA,
    CX,
    CY,
    FISHEYE,
    FX,
    FY,
    K1,
    K2,
    K3,
    K4,
    K5,
    K6,
    P1,
    P2,
    PANORAMA,
    PERSPECTIVE,
    SX,
    SY,
)
from sfm_app.jit import inlined_kernel, kernel
from sfm_app.types.arrays import FloatArray, IndexArray

NEAR_AXIS = 1e-5
"""Slope below which a ray counts as the optical axis of a fisheye, where its derivatives are 0/0: the first neglected
term is its square. By definition: the root of double precision, rounded."""
SEEN_ANGLE = 0.5 * np.pi
"""Largest angle to the optical axis that a fisheye shows: COLMAP 4.2 projects nothing behind it. By definition."""
RAY, SLOPES, RADIUS = slice(0, 3), slice(3, 9), 9
"""Entries of `unproject_point`. By definition."""
BEARING = 9
"""Number of the entries without the radius. Counted."""
EQUIDISTANT_BELOW = 1e-6
"""Exponents nearer to 0 are taken as 0: the series agree to double precision."""


class UnprojectionOptions(NamedTuple):
    """Limits of unprojection; a named tuple, as kernels read it."""

    radius_steps: int = 30
    """Most steps of Newton's method for the radius. Chosen by hand."""
    last_step: float = 1e-9
    """Step in focal lengths below which it is the last one: the digits double. Chosen by hand."""
    shift_steps: int = 50
    """Most steps for the terms that are not radial. Counted: each multiplies the error by 0.01 at most."""
    last_shift: float = 1e-13
    """Change in focal lengths below which these end. Chosen by hand."""
    least_slope: float = 0.05
    """Least slope of the distorted radius: below it, the lens is near its fold. Chosen by hand."""
    most_radius: float = 12.0
    """Radius in focal lengths up to which a perspective lens is searched for a fold: 85 degrees. Chosen by hand."""
    radii: int = 2048
    """Number of radii of this search. Chosen by hand."""


OPTIONS = UnprojectionOptions()
Two = tuple[float, float]
Terms = tuple[float, float, float, float, float, float, float, float]
"""Parameters of a camera from k1 on. Kernels pass tuples, as numba counts the references to every array."""
End = tuple[float, float, float]
"""The end of a lens: its `fold_radius`, the least slope there, and the growth of the radius beyond it."""


# One point.


@kernel
def lens_terms(camera: FloatArray) -> Terms:
    """Return the terms of a camera (12,)."""
    return (camera[4], camera[5], camera[6], camera[7], camera[8], camera[9], camera[10], camera[11])


@inlined_kernel
def _has_one_term(terms: Terms, family: int) -> bool:
    """Return whether k1 is the only radial term."""
    _, k2, _, _, k3, k4, k5, k6 = terms
    return k2 == 0.0 and k3 == 0.0 and k4 == 0.0 and (family == FISHEYE or (k5 == 0.0 and k6 == 0.0))


@inlined_kernel
def _is_straight(terms: Terms) -> bool:
    """Return whether a lens has no distortion."""
    k1, k2, p1, p2, k3, k4, k5, k6 = terms
    return k1 == 0.0 and k2 == 0.0 and p1 == 0.0 and p2 == 0.0 and k3 == 0.0 and k4 == k5 == k6 == 0.0


@inlined_kernel
def radial_factor(r2: float, terms: Terms, family: int) -> tuple[float, float, float]:
    """Return the radial factor at a squared radius before distortion, its derivative by that, and its denominator."""
    k1, k2, _, _, k3, k4, k5, k6 = terms
    if _has_one_term(terms, family):  # a short cut, as where k4 is 0
        return 1.0 + r2 * k1, k1, 1.0
    if family == FISHEYE:
        factor = 1.0 + r2 * (k1 + r2 * (k2 + r2 * (k3 + r2 * k4)))
        return factor, k1 + r2 * (2.0 * k2 + r2 * (3.0 * k3 + 4.0 * r2 * k4)), 1.0
    above, climb = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3)), k1 + r2 * (2.0 * k2 + 3.0 * r2 * k3)
    if k4 == 0.0 and k5 == 0.0 and k6 == 0.0:
        return above, climb, 1.0
    below = 1.0 + r2 * (k4 + r2 * (k5 + r2 * k6))
    factor = above / below
    return factor, (climb - factor * (k4 + r2 * (2.0 * k5 + 3.0 * r2 * k6))) / below, below


@kernel
def distort_point(u: float, v: float, factor: float, terms: Terms, family: int) -> Two:
    """Return a point after distortion, in focal lengths; `factor` is the radial one."""
    _, _, p1, p2, _, _, sx, sy = terms
    r2, uv = u * u + v * v, 2.0 * u * v
    x, y = u * factor + p1 * uv + p2 * (r2 + 2.0 * u * u), v * factor + p2 * uv + p1 * (r2 + 2.0 * v * v)
    if family == FISHEYE:
        return x + sx * r2, y + sy * r2
    return x, y


@kernel
def plane_point(X: float, Y: float, Z: float, family: int) -> Two:
    """Return the point before distortion that shows a point of the camera's frame; the camera is no panorama."""
    gain = 1.0 / Z if family == PERSPECTIVE else _axial_gain(X, Y, Z)
    return gain * X, gain * Y


@kernel
def _axial_gain(X: float, Y: float, Z: float) -> float:
    """Return the ratio of the angle to the distance from the optical axis."""
    side = np.hypot(X, Y)
    if side < NEAR_AXIS * abs(Z) and Z > 0.0:
        return float(1.0 / Z)
    return float(np.arctan2(side, Z) / side)


@kernel
def project_point(X: float, Y: float, Z: float, camera: FloatArray, family: int) -> Two:
    """Return the pixel of a point of the camera's frame; meaningless where the camera cannot see it."""
    if family == PANORAMA:
        x, y = np.arctan2(X, Z), np.arctan2(Y, np.hypot(X, Z))
    else:
        (u, v), terms = plane_point(X, Y, Z, family), lens_terms(camera)
        x, y = distort_point(u, v, radial_factor(u * u + v * v, terms, family)[0], terms, family)
    return camera[FX] * x + camera[CX], camera[FY] * y + camera[CY]


@inlined_kernel
def unproject_point(
    point: Two, focals: Two, terms: Terms, family: int, end: End, guess: float, out: FloatArray
) -> None:
    """Write the ray that a pixel sees, its derivatives by x and y, and its radius before distortion into `out` (10,).

    `point` counts from the optical center in focal lengths. Rays of a perspective camera end on the plane z = 1, others
    have length 1. Derivatives leave out the terms that are not radial. `guess` is the radius through a similar camera,
    negative for none.
    """
    (a, b), per_x, per_y = point, 1.0 / focals[0], 1.0 / focals[1]
    if family == PANORAMA:
        east, north, down, level = np.sin(a), np.cos(a), np.sin(b), np.cos(b)
        out[0], out[1], out[2] = level * east, down, level * north
        out[3], out[4], out[5] = level * north * per_x, 0.0, -level * east * per_x
        out[6], out[7], out[8] = -down * east * per_y, level * per_y, -down * north * per_y
        return
    if family == PERSPECTIVE and _is_straight(terms):
        out[0], out[1], out[2] = a, b, 1.0
        out[3], out[4], out[5] = per_x, 0.0, 0.0
        out[6], out[7], out[8] = 0.0, per_y, 0.0
        out[9] = np.hypot(a, b)
        return
    a, b = _remove_shift(a, b, terms, family, end)
    r2 = a * a + b * b
    radius = np.sqrt(r2)
    if guess < 0.0:
        guess = radius / (1.0 + max(terms[0], 0.0) * r2)
    r = _undistort_radius(radius, terms, family, end, guess)
    factor, slope, _ = radial_factor(r * r, terms, family)
    growth = 1.0 / max(factor + 2.0 * r * r * slope, end[1])
    side, along, side_growth, along_growth = r, 1.0, growth, 0.0
    if family == FISHEYE:
        side, along = np.sin(r), np.cos(r)
        side_growth, along_growth = along * growth, -side * growth
    scale, twist, tilt = 1.0, 0.0, 0.0
    if radius > 1e-9:  # at the center, all directions are alike
        scale = side / radius
        tilt = along_growth / radius if family == FISHEYE else 0.0
        twist = (side_growth - scale) / r2
    out[0], out[1], out[2] = scale * a, scale * b, along
    out[3], out[4], out[5] = (scale + twist * a * a) * per_x, twist * a * b * per_x, tilt * a * per_x
    out[6], out[7], out[8] = twist * a * b * per_y, (scale + twist * b * b) * per_y, tilt * b * per_y
    out[9] = r


@inlined_kernel
def _undistort_radius(radius: float, terms: Terms, family: int, end: End, guess: float) -> float:
    """Return the radius before distortion, by Newton's method within bounds of a bisection, from a guess."""
    fold, least_slope, rate = end
    if radius < 1e-9:
        return radius
    if fold < np.inf:
        beyond = radius - fold * radial_factor(fold * fold, terms, family)[0]
        if beyond >= 0.0:
            return float(fold + rate * beyond)
    low, high, r = 0.0, fold, min(guess, fold)
    for _ in range(OPTIONS.radius_steps):
        factor, slope, _ = radial_factor(r * r, terms, family)
        error = r * factor - radius
        if error < 0.0:
            low = r
        else:
            high = r
        step = error / max(factor + 2.0 * r * r * slope, least_slope)
        if not low <= r - step <= high:
            r = 0.5 * (low + high)
        elif abs(step) < OPTIONS.last_step:
            return float(r - step)
        else:
            r -= step
    return r


@inlined_kernel
def _remove_shift(x: float, y: float, terms: Terms, family: int, end: End) -> Two:
    """Return a point in focal lengths as the radial terms alone would show it."""
    _, _, p1, p2, _, _, sx, sy = terms
    if p1 == 0.0 and p2 == 0.0 and (family == PERSPECTIVE or (sx == 0.0 and sy == 0.0)):
        return x, y
    a, b = x, y
    for _ in range(OPTIONS.shift_steps):
        radius = np.hypot(a, b)
        scale = _undistort_radius(radius, terms, family, end, radius) / radius if radius > 0.0 else 1.0
        shift_x, shift_y = distort_point(scale * a, scale * b, 0.0, terms, family)
        change = max(abs(x - shift_x - a), abs(y - shift_y - b))
        a, b = x - shift_x, y - shift_y
        if change < OPTIONS.last_shift:
            break
    return a, b


@kernel
def _grows(r: float, terms: Terms, family: int, least_slope: float) -> bool:
    factor, slope, _ = radial_factor(r * r, terms, family)
    return bool(factor > 0.0 and factor + 2.0 * r * r * slope >= least_slope)


@inlined_kernel
def fold_radius(terms: Terms, family: int, least_slope: float) -> float:
    """Return the radius before distortion up to which the slope of the distorted one is at least `least_slope`.

    A fisheye ends at pi, a perspective lens with more than one radial term at `OPTIONS.most_radius`.
    """
    most = np.pi if family == FISHEYE else np.inf
    k1 = terms[0]
    if _has_one_term(terms, family):
        return min(np.sqrt((least_slope - 1.0) / (3.0 * k1)), most) if k1 < 0.0 else most
    step = min(most, OPTIONS.most_radius) / (OPTIONS.radii - 1)
    for k in range(1, OPTIONS.radii):
        if not _grows(k * step, terms, family, least_slope):
            low, high = (k - 1) * step, k * step
            for _ in range(50):  # as many halvings as numbers in double precision have bits
                middle = 0.5 * (low + high)
                if _grows(middle, terms, family, least_slope):
                    low = middle
                else:
                    high = middle
            return low
    return min(most, OPTIONS.most_radius)


# Many points.


class Projected(NamedTuple):
    """Projected points, and their derivatives."""

    x: FloatArray
    """(N, 2) pixels."""
    by_camera: FloatArray
    """(N, 2, 12)"""
    by_point: FloatArray
    """(N, 2, 3) by the point in the camera's frame."""


def project_points(points: FloatArray, params: FloatArray, family: IndexArray | int) -> Projected:
    """Project points (N, 3), each in the frame of its camera; meaningless where the camera cannot see them.

    The cameras are rows (N, 12) with their families (N,), or one camera (12,) of all points.
    """
    projected = Projected(image_points(points, params, family), *(np.zeros((len(points), 2, k)) for k in (CAMERA, 3)))
    _write_derivatives(*_contiguous(points, params, family), projected.by_camera, projected.by_point)
    return projected


def image_points(points: FloatArray, params: FloatArray, family: IndexArray | int) -> FloatArray:
    """Return pixels (N, 2) of points, without derivatives, as `project_points` does."""
    return _project_all(*_contiguous(points, params, family))


def _contiguous(points: FloatArray, params: FloatArray, family: ArrayLike) -> tuple[FloatArray, FloatArray, IndexArray]:
    rows = np.ascontiguousarray(params, np.float64).reshape(-1, CAMERA)
    kinds = np.ascontiguousarray(np.broadcast_to(np.asarray(family, np.int64), len(rows)))
    return np.ascontiguousarray(points, np.float64), rows, kinds


@kernel
def _project_all(points: FloatArray, params: FloatArray, family: IndexArray) -> FloatArray:
    x, last = np.empty((len(points), 2)), len(params) - 1
    for i in range(len(points)):
        k = min(i, last)
        x[i, 0], x[i, 1] = project_point(points[i, 0], points[i, 1], points[i, 2], params[k], family[k])
    return x


@kernel
def _write_derivatives(
    points: FloatArray, params: FloatArray, family: IndexArray, by_camera: FloatArray, by_point: FloatArray
) -> None:
    """Write the derivatives of `project_point` into zeros (N, 2, 12) and (N, 2, 3)."""
    for i in range(len(points)):
        k = min(i, len(params) - 1)
        X, Y, Z, camera = points[i, 0], points[i, 1], points[i, 2], params[k]
        A, B, terms = by_camera[i], by_point[i], lens_terms(camera)
        fx, fy, p1, p2 = camera[FX], camera[FY], camera[P1], camera[P2]
        square = X * X + Y * Y + Z * Z
        if family[k] == PANORAMA:
            level = np.hypot(X, Z)
            scale = fy / (level * square)
            B[0, 0], B[0, 2] = fx * Z / level**2, -fx * X / level**2
            B[1, 0], B[1, 1], B[1, 2] = -scale * X * Y, scale * level**2, -scale * Y * Z
            continue
        u, v = plane_point(X, Y, Z, family[k])
        r2, uv = u * u + v * v, 2.0 * u * v
        factor, slope, below = radial_factor(r2, terms, family[k])
        A[0, FX], A[1, FY] = distort_point(u, v, factor, terms, family[k])
        A[0, CX] = A[1, CY] = 1.0
        A[0, P1], A[0, P2] = fx * uv, fx * (r2 + 2.0 * u * u)
        A[1, P1], A[1, P2] = fy * (r2 + 2.0 * v * v), fy * uv
        term = 1.0 / below
        for place, other in ((K1, K4), (K2, K5), (K3, K6)):
            term *= r2
            A[0, place], A[1, place] = fx * u * term, fy * v * term
            if family[k] == PERSPECTIVE:
                A[0, other], A[1, other] = -factor * A[0, place], -factor * A[1, place]
        cross = uv * slope + 2.0 * (p1 * u + p2 * v)
        x_by_u, x_by_v = factor + 2.0 * u * u * slope + 2.0 * p1 * v + 6.0 * p2 * u, cross
        y_by_u, y_by_v = cross, factor + 2.0 * v * v * slope + 2.0 * p2 * u + 6.0 * p1 * v
        if family[k] == FISHEYE:
            A[0, K4], A[1, K4] = fx * u * term * r2, fy * v * term * r2
            A[0, SX], A[1, SY] = fx * r2, fy * r2
            sx, sy = 2.0 * camera[SX], 2.0 * camera[SY]
            x_by_u, x_by_v, y_by_u, y_by_v = x_by_u + sx * u, x_by_v + sx * v, y_by_u + sy * u, y_by_v + sy * v
            side, gain = np.hypot(X, Y), _axial_gain(X, Y, Z)
            near = side < NEAR_AXIS * abs(Z) and Z > 0.0
            bend = -2.0 / (3.0 * Z**3) if near else (Z / square - gain) / side**2
            B[0, 0], B[0, 1], B[0, 2] = gain + X * X * bend, X * Y * bend, -X / square
            B[1, 0], B[1, 1], B[1, 2] = X * Y * bend, gain + Y * Y * bend, -Y / square
        else:
            B[0, 0], B[0, 2], B[1, 1], B[1, 2] = 1.0 / Z, -u / Z, 1.0 / Z, -v / Z
        # so far of u and v, by the chain rule of x and y
        for j in range(3):
            along_u, along_v = B[0, j], B[1, j]
            B[0, j] = fx * (x_by_u * along_u + x_by_v * along_v)
            B[1, j] = fy * (y_by_u * along_u + y_by_v * along_v)


def wrap_residuals(r: FloatArray, params: FloatArray, family: IndexArray) -> FloatArray:
    """Return residuals (N, 2) in pixels, with those of panoramas taken the short way round."""
    panoramic = family == PANORAMA
    if panoramic.any():
        r = r.copy()
        width = 2.0 * np.pi * params[panoramic, FX]
        r[panoramic, 0] -= width * np.rint(r[panoramic, 0] / width)
    return r


def image_rays(x: FloatArray, camera: FloatArray, family: int) -> FloatArray:
    """Return the rays of pixels (N, 2), and their derivatives by x and by y, (N, 9), as in `unproject_point`."""
    return _unproject_all(np.ascontiguousarray(x, np.float64), np.ascontiguousarray(camera, np.float64), family)


@kernel
def _unproject_all(x: FloatArray, camera: FloatArray, family: int) -> FloatArray:
    terms, focals = lens_terms(camera), (camera[FX], camera[FY])
    end = fold_radius(terms, family, OPTIONS.least_slope), OPTIONS.least_slope, 0.0
    rays, out = np.empty((len(x), BEARING)), np.empty(BEARING + 1)
    for i in range(len(x)):
        point = (x[i, 0] - camera[CX]) / camera[FX], (x[i, 1] - camera[CY]) / camera[FY]
        unproject_point(point, focals, terms, family, end, -1.0, out)
        rays[i] = out[:BEARING]
    return rays


# The curve of a lens: the radius over the angle to the optical axis, without tangential terms.


def radius_at(angle: FloatArray, params: FloatArray, family: int) -> FloatArray:
    """Return radii (N,) in focal lengths of rays at angles (N,) >= 0 to the optical axis, without tangential terms."""
    r = np.tan(angle) if family == PERSPECTIVE else angle
    return _distort_radii(np.ascontiguousarray(r, np.float64), np.ascontiguousarray(params, np.float64), family)


@kernel
def _distort_radii(r: FloatArray, camera: FloatArray, family: int) -> FloatArray:
    terms = lens_terms(camera)
    return np.array([one * radial_factor(one * one, terms, family)[0] for one in r])


def angle_limit(params: FloatArray, family: int, reach: float) -> float:
    """Return the angle at which the radius reaches `reach` focal lengths; NaN if the lens folds before that."""
    angle, radius = _sampled_curve(params, family)
    ends = np.flatnonzero(radius >= reach)
    # a fisheye may end inside the photo, at a right angle
    end = ends[0] if len(ends) else len(angle) - 1
    grows = np.isfinite(radius[: end + 1]).all() and np.all(np.diff(radius[: end + 1]) > 0.0)
    return float(angle[end]) if grows and (len(ends) or family == FISHEYE) else float("nan")


def shown_angle(params: FloatArray, family: int, reach: float) -> float:
    """Return the largest angle that a lens shows: where its radius reaches `reach` (see `angle_limit`), or folds."""
    angle, radius = _sampled_curve(params, family)
    folds, ends = np.flatnonzero(~(np.diff(radius) > 0.0)), np.flatnonzero(radius >= reach)
    last = len(angle) - 1
    return float(angle[min(folds[0] if len(folds) else last, ends[0] if len(ends) else last)])


def _sampled_curve(params: FloatArray, family: int) -> tuple[FloatArray, FloatArray]:
    """Return 256 angles, up to 85 degrees of a perspective lens (chosen by hand), and their radii."""
    angle = np.linspace(0.0, np.radians(85.0) if family == PERSPECTIVE else SEEN_ANGLE, 256)
    return angle, radius_at(angle, params, family)


@dataclass(frozen=True, slots=True)
class Fisheye:
    """A lens without distortion and with one focal, in any unit of length.

    A ray at the angle theta to the optical axis comes to lie at the radius, in focal lengths::

        r = tan(e theta) / e (e > 0),    theta (e = 0),    sin(-e theta) / -e (e < 0).

    e = 1 is a perspective lens, 1/2 stereographic, 0 equidistant, -1/2 equisolid, -1 orthographic. All have the same
    scale about the center, the focal length.
    """

    focal: float
    exponent: float
    center: tuple[float, float] = (0.0, 0.0)

    def radius(self, theta: FloatArray) -> FloatArray:
        """Return the radius about the center of rays at angles `theta` (N,), in radians, to the optical axis."""
        e = self.exponent
        if abs(e) < EQUIDISTANT_BELOW:
            return np.asarray(self.focal * theta, np.float64)
        return np.asarray(self.focal * (np.tan(e * theta) / e if e > 0 else np.sin(-e * theta) / -e), np.float64)

    def angle(self, radius: FloatArray) -> FloatArray:
        """Return the angle to the optical axis, in radians; points beyond the image circle lie on it."""
        r, e = np.asarray(radius) / self.focal, self.exponent
        if abs(e) < EQUIDISTANT_BELOW:
            return np.asarray(np.minimum(r, np.pi), np.float64)
        angle = np.arctan(e * r) / e if e > 0 else np.arcsin(np.minimum(-e * r, 1.0)) / -e
        return np.asarray(np.minimum(angle, np.pi), np.float64)

    def rays(self, points: FloatArray) -> FloatArray:
        """Return (N, 3) directions of length 1 of points (N, 2)."""
        about = points - np.array(self.center)
        radius = np.hypot(about[:, 0], about[:, 1])
        theta = self.angle(radius)
        along = np.divide(np.sin(theta), radius, out=np.full_like(radius, 1.0 / self.focal), where=radius > 0.0)
        return np.column_stack([about * along[:, None], np.cos(theta)])

    def project(self, rays: FloatArray) -> FloatArray:
        """Return (N, 2) points of rays (N, 3) of any length."""
        side = np.hypot(rays[:, 0], rays[:, 1])
        radius = self.radius(np.arctan2(side, rays[:, 2]))
        return rays[:, :2] * np.divide(radius, side, out=np.zeros_like(side), where=side > 0.0)[:, None] + self.center

    def field_deg(self, width: float) -> float:
        """Return the angle between the rays to both ends of a width about the center, in degrees."""
        return float(2.0 * np.degrees(self.angle(np.array([0.5 * width]))[0]))
