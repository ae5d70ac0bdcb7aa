"""Projections of perspective, fisheye and equirectangular cameras, with their derivatives.

The cameras are those of COLMAP: perspective ones FULL_OPENCV (Brown 1971, with a rational radial factor), fisheyes
THIN_PRISM_FISHEYE (Kannala and Brandt 2006; Weng et al. 1992), panoramas EQUIRECTANGULAR. Smaller models of COLMAP are
these with zeros.
"""

from typing import NamedTuple

import numpy as np

from sfm_app.types.arrays import FloatArray, IndexArray

FX, FY, CX, CY, K1, K2, P1, P2, K3, K4, K5, K6 = range(12)
"""Indices of the parameters of a perspective camera, as in COLMAP's FULL_OPENCV; the first ten also of a fisheye."""
SX, SY = K5, K6
"""Indices of sx1 and sy1 of a fisheye, as in COLMAP's THIN_PRISM_FISHEYE."""
CAMERA = 12
"""Number of parameters of a camera. By definition."""
PERSPECTIVE, FISHEYE, PANORAMA = range(3)
"""Families of cameras. A panorama has fx and fy in pixels per radian, cx and cy in pixels, and none of them is free."""
NEAR_AXIS = 1e-5
"""Slope below which a ray counts as the optical axis of a fisheye, where its derivatives are 0/0: the first neglected
term is its square. By definition: the root of double precision, rounded."""
SEEN_ANGLE = 0.5 * np.pi
"""Largest angle to the optical axis that a fisheye shows: COLMAP 4.2 projects nothing behind it. By definition."""


class Projected(NamedTuple):
    """Projected points, and their derivatives."""

    x: FloatArray
    """(N, 2) pixels."""
    by_camera: FloatArray
    """(N, 2, 12)"""
    by_point: FloatArray
    """(N, 2, 3) by the point in the camera's frame."""


def project_points(points: FloatArray, params: FloatArray, family: IndexArray) -> Projected:
    """Project points (N, 3), each in the frame of its camera (N, 12); meaningless where the camera cannot see them."""
    kinds = np.unique(family)
    if len(kinds) == 1:
        return _PROJECTIONS[kinds[0]](points, params)
    N = len(points)
    projected = Projected(np.zeros((N, 2)), np.zeros((N, 2, CAMERA)), np.zeros((N, 2, 3)))
    for kind in kinds:
        rows = np.flatnonzero(family == kind)
        for whole, part in zip(projected, _PROJECTIONS[kind](points[rows], params[rows]), strict=True):
            whole[rows] = part
    return projected


def image_points(points: FloatArray, params: FloatArray, family: IndexArray) -> FloatArray:
    """Return pixels (N, 2) of points, without derivatives, as `project_points` does."""
    kinds = np.unique(family)
    if len(kinds) == 1:
        return _POSITIONS[kinds[0]](points, params)
    x = np.zeros((len(points), 2))
    for kind in kinds:
        rows = np.flatnonzero(family == kind)
        x[rows] = _POSITIONS[kind](points[rows], params[rows])
    return x


def wrap_residuals(r: FloatArray, params: FloatArray, family: IndexArray) -> FloatArray:
    """Return residuals (N, 2) in pixels, with those of panoramas taken the short way round."""
    panoramic = family == PANORAMA
    if panoramic.any():
        r = r.copy()
        width = 2.0 * np.pi * params[panoramic, FX]
        r[panoramic, 0] -= width * np.rint(r[panoramic, 0] / width)
    return r


def radius_at(angle: FloatArray, params: FloatArray, family: int) -> FloatArray:
    """Return radii (N,) in focal lengths of rays at angles (N,) >= 0 to the optical axis, without tangential terms."""
    r = np.tan(angle) if family == PERSPECTIVE else angle
    return np.asarray(r * _radial_factor(r * r, np.asarray(params)[None], family)[0], np.float64)


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


def _place_perspective(points: FloatArray, params: FloatArray) -> FloatArray:
    X, Y, Z = points.T
    u, v = X / Z, Y / Z
    return _pixels(*_bend(u, v, _radial_factor(u * u + v * v, params, PERSPECTIVE)[0], params), params)


def _place_fisheye(points: FloatArray, params: FloatArray) -> FloatArray:
    X, Y, Z = points.T
    side = np.hypot(X, Y)
    theta = np.arctan2(side, Z)
    gain = _axial_gain(side, theta, Z)
    t2 = theta * theta
    x = _pixels(*_bend(gain * X, gain * Y, _radial_factor(t2, params, FISHEYE)[0], params), params)
    prism = params[:, [SX, SY]]
    return x + params[:, [FX, FY]] * prism * t2[:, None] if prism.any() else x


def _place_panorama(points: FloatArray, params: FloatArray) -> FloatArray:
    X, Y, Z = points.T
    fx, fy, cx, cy = params[:, : CY + 1].T
    return np.stack([fx * np.arctan2(X, Z) + cx, fy * np.arctan2(Y, np.hypot(X, Z)) + cy], -1)


_POSITIONS = {PERSPECTIVE: _place_perspective, FISHEYE: _place_fisheye, PANORAMA: _place_panorama}


def _axial_gain(side: FloatArray, theta: FloatArray, Z: FloatArray) -> FloatArray:
    """Return ratios (N,) of the angle to the distance from the optical axis."""
    near = (side < NEAR_AXIS * np.abs(Z)) & (Z > 0.0)
    return np.where(near, 1.0 / Z, theta / np.where(near, 1.0, side))


def _project_perspective(points: FloatArray, params: FloatArray) -> Projected:
    X, Y, Z = points.T
    u, v = X / Z, Y / Z
    nil, one = np.zeros_like(u), np.ones_like(u)
    uv_by_x = np.stack([np.stack([one, nil, -u], -1), np.stack([nil, one, -v], -1)], 1) / Z[:, None, None]
    r2 = u * u + v * v
    radial, slope, below = _radial_factor(r2, params, PERSPECTIVE)
    powers = [r2 / below, r2**2 / below, r2**3 / below]
    terms = [*powers, *(-radial * power for power in powers)]
    return _distort(u, v, (radial, slope), params, (terms, (K1, K2, K3, K4, K5, K6)), uv_by_x)


def _project_fisheye(points: FloatArray, params: FloatArray) -> Projected:
    X, Y, Z = points.T
    side, square = np.hypot(X, Y), np.einsum("ni,ni->n", points, points)
    theta = np.arctan2(side, Z)
    near = (side < NEAR_AXIS * np.abs(Z)) & (Z > 0.0)
    gain = _axial_gain(side, theta, Z)
    bend = np.where(near, -2.0 / (3.0 * Z**3), (Z / square - gain) / np.where(near, 1.0, side) ** 2)
    u, v = gain * X, gain * Y
    uv_by_x = np.stack(
        [
            np.stack([gain + X * X * bend, X * Y * bend, -X / square], -1),
            np.stack([X * Y * bend, gain + Y * Y * bend, -Y / square], -1),
        ],
        1,
    )
    t2 = theta * theta
    radial, slope, _ = _radial_factor(t2, params, FISHEYE)
    terms = [t2, t2**2, t2**3, t2**4]
    projected = _distort(u, v, (radial, slope), params, (terms, (K1, K2, K3, K4)), uv_by_x)
    prism = params[:, [SX, SY]]
    if prism.any():
        outward = np.einsum("ni,nij->nj", np.stack([u, v], -1), uv_by_x)
        scale = params[:, [FX, FY]] * prism
        projected.by_point[:] += 2.0 * scale[:, :, None] * outward[:, None]
        projected.x[:] += scale * t2[:, None]
        projected.by_camera[:, [0, 1], [FX, FY]] += prism * t2[:, None]
    projected.by_camera[:, [0, 1], [SX, SY]] = params[:, [FX, FY]] * t2[:, None]
    return projected


def _project_panorama(points: FloatArray, params: FloatArray) -> Projected:
    X, Y, Z = points.T
    fx, fy = params[:, : FY + 1].T
    level, square = np.hypot(X, Z), np.einsum("ni,ni->n", points, points)
    across = np.stack([fx * Z / level**2, np.zeros_like(X), -fx * X / level**2], -1)
    upright = np.stack([-X * Y / level, level, -Y * Z / level], -1) * (fy / square)[:, None]
    x = _place_panorama(points, params)
    return Projected(x, np.zeros((len(x), 2, CAMERA)), np.stack([across, upright], 1))


_PROJECTIONS = {PERSPECTIVE: _project_perspective, FISHEYE: _project_fisheye, PANORAMA: _project_panorama}


def _radial_factor(r2: FloatArray, params: FloatArray, family: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the radial factor of squared radii (N,), its derivative by them, and its denominator."""
    k1, k2, k3, k4, k5, k6 = params[:, [K1, K2, K3, K4, K5, K6]].T
    if family == FISHEYE:
        factor = 1.0 + r2 * (k1 + r2 * (k2 + r2 * (k3 + r2 * k4)))
        return factor, k1 + r2 * (2.0 * k2 + r2 * (3.0 * k3 + 4.0 * r2 * k4)), np.ones_like(r2)
    above, below = (1.0 + r2 * (a + r2 * (b + r2 * c)) for a, b, c in ((k1, k2, k3), (k4, k5, k6)))
    factor = above / below
    climb, fall = (a + r2 * (2.0 * b + 3.0 * r2 * c) for a, b, c in ((k1, k2, k3), (k4, k5, k6)))
    return factor, (climb - factor * fall) / below, below


def _bend(u: FloatArray, v: FloatArray, factor: FloatArray, params: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return distorted coordinates (N,), (N,) in focal lengths; `factor` is the radial one."""
    p1, p2 = params[:, [P1, P2]].T
    r2, uv = u * u + v * v, 2.0 * u * v
    return u * factor + p1 * uv + p2 * (r2 + 2.0 * u * u), v * factor + p2 * uv + p1 * (r2 + 2.0 * v * v)


def _pixels(ud: FloatArray, vd: FloatArray, params: FloatArray) -> FloatArray:
    fx, fy, cx, cy = params[:, : CY + 1].T
    return np.stack([fx * ud + cx, fy * vd + cy], -1)


def _distort(
    u: FloatArray, v: FloatArray, radial: tuple[FloatArray, FloatArray], params: FloatArray,
    terms: tuple[list[FloatArray], tuple[int, ...]], uv_by_x: FloatArray,
) -> Projected:  # fmt: skip
    """Return the projection of undistorted points u, v, (N,) each in focal lengths.

    Args:
        radial: factor of the radius, and its derivative by the squared radius.
        terms: derivatives of the factor by radial parameters, and the indices of these.
        uv_by_x: (N, 2, 3) derivatives of u and v by the point.
    """
    fx, fy = params[:, : FY + 1].T
    p1, p2 = params[:, [P1, P2]].T
    factor, slope = radial
    r2, uv = u * u + v * v, 2.0 * u * v
    across, upright = r2 + 2.0 * u * u, r2 + 2.0 * v * v
    ud, vd = _bend(u, v, factor, params)
    by_camera = np.zeros((len(u), 2, CAMERA))
    by_camera[:, 0, FX], by_camera[:, 1, FY] = ud, vd
    by_camera[:, 0, CX] = by_camera[:, 1, CY] = 1.0
    by_camera[:, 0, P1], by_camera[:, 0, P2] = fx * uv, fx * across
    by_camera[:, 1, P1], by_camera[:, 1, P2] = fy * upright, fy * uv
    for term, place in zip(*terms, strict=True):
        by_camera[:, 0, place], by_camera[:, 1, place] = fx * u * term, fy * v * term
    cross = uv * slope + 2.0 * (p1 * u + p2 * v)
    uu = factor + 2.0 * u * u * slope + 2.0 * p1 * v + 6.0 * p2 * u
    vv = factor + 2.0 * v * v * slope + 2.0 * p2 * u + 6.0 * p1 * v
    by_uv = np.stack([np.stack([fx * uu, fx * cross], -1), np.stack([fy * cross, fy * vv], -1)], 1)
    return Projected(_pixels(ud, vd, params), by_camera, np.einsum("nij,njk->nik", by_uv, uv_by_x))
