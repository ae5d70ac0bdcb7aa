"""Place, heading and scale of a reconstruction on Earth, from the GPS positions of its photos."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from sfm_app.frame.coordinates import GPS_SYSTEM, LocalFrame, read_system
from sfm_app.geometry.poses import Similarity, draw_pairs, perpendicular_basis, robust_similarity
from sfm_app.numerical import FAILURES, MAD_TO_SIGMA
from sfm_app.types import GpsPosition, Rejected
from sfm_app.types.arrays import BoolArray, FloatArray
from sfm_app.types.photos import FILE

MIN_POSITIONS = 3
"""Least number of distinct positions that must agree."""


class OPTIONS:
    """Constants of the fit to GPS positions."""

    max_residual_m: float = 10.0
    """Largest residual that consumer GPS explains."""
    max_residual_share: float = 0.15
    """The same, as a share of the spread of the photos; the larger one counts."""
    deviation_m: float = 5.0
    """Standard deviation of positions without one: consumer GPS errs by 3 to 10 m."""
    min_deviation_m: float = 0.02
    """Least deviation that counts: antennas are a hand away from lenses. Chosen by hand."""
    significance: float = 1e-3
    """Largest probability that positions unrelated to the cameras fit as well."""
    max_scale_deviation: float = 0.1
    min_share: float = 0.6
    max_up_deviation_deg: float = 2.0
    """Largest standard deviation with which up from GPS replaces up from the cameras' roll."""
    max_pairs: int = 500
    min_gain: float = 2.0
    """Least factor by which swapping latitude and longitude reduces the residuals of a file that has them swapped, and
    by which up from positions reduces those with a sure up, which is then wrong."""


@dataclass(frozen=True, slots=True, eq=False)
class Georeference:
    """The similarity from the reconstruction to meters on the ground."""

    enu_from_world: Similarity
    """To meters east, north and up of `origin`."""
    origin: GpsPosition
    """Position of (0, 0, 0); without altitude, heights are relative to the cameras' median height."""
    inliers: int
    """Number of distinct positions that agree."""
    positions: int
    rms_m: float
    """Root mean square horizontal residual of the agreeing positions."""
    scale_deviation: float
    """Relative standard deviation of the scale."""
    up_deviation_deg: float | None = None
    """Standard deviation of up if it comes from the positions and their altitudes; None if up was given."""


def georeference(
    centers: FloatArray, positions: Sequence[GpsPosition | None], up: FloatArray, *, up_is_sure: bool = True
) -> Georeference | Rejected:
    """Find scale, heading and place from the positions of the photos, if these agree with the cameras.

    GPS errs by 3 to 10 m horizontally and twice that in height. So up stays as given, and only horizontal positions
    are used: w = a z + b in complex numbers, by RANSAC over pairs, then least squares. An unsure up is replaced by that
    of the positions if they determine it well; a sure one, if it leaves residuals that theirs does not. Centers (N, 3)
    and `up` (3,) are in the frame of the reconstruction.
    """
    cameras = centers[[position is not None for position in positions]]
    given = [position for position in positions if position is not None]
    if not given:
        return Rejected("the photos have no positions")
    if len(set(given)) < MIN_POSITIONS:
        return Rejected(f"{len(set(given))} different positions, {MIN_POSITIONS} are needed")
    fit = _fit_positions(cameras, given, up, up_is_sure)
    if max(abs(one.longitude_deg) for one in given) > 90.0:
        return fit
    swapped = [replace(one, latitude_deg=one.longitude_deg, longitude_deg=one.latitude_deg) for one in given]
    other = _fit_positions(cameras, swapped, up, up_is_sure)
    rms_m = fit.rms_m if isinstance(fit, Georeference) else np.inf
    if isinstance(other, Georeference) and OPTIONS.min_gain * other.rms_m < min(rms_m, _width(swapped)):
        now = f"they miss by {rms_m:.2g} m" if fit else "they do not agree"
        place = "file of positions" if given[0].zero == FILE else "EXIF"
        swap = "latitude and longitude are probably swapped"
        return Rejected(f"{swap}: {now}, and swapped by {other.rms_m:.2g} m; correct the {place}")
    return fit


def _width(positions: Sequence[GpsPosition]) -> float:
    """Return the deviation of positions across their main horizontal direction in meters. A line also fits mirrored."""
    return float(np.sqrt(np.linalg.eigvalsh(np.cov(enu_m(positions, _median_position(positions))[:, :2].T))[0]))


def _fit_positions(
    cameras: FloatArray, given: Sequence[GpsPosition], up: FloatArray, up_is_sure: bool
) -> Georeference | Rejected:
    origin = _median_position(given)
    enu = enu_m(given, origin)
    level = _fit_on_ground(cameras, enu, up, given)
    gps_up = _up_from_positions(cameras, enu, given)
    tilted = _fit_on_ground(cameras, enu, gps_up[0], given) if gps_up else level
    if gps_up is None or not isinstance(tilted, Georeference):
        return level
    if up_is_sure and isinstance(level, Georeference) and OPTIONS.min_gain * tilted.rms_m > level.rms_m:
        return level
    return replace(tilted, up_deviation_deg=gps_up[1])


def enu_m(positions: Sequence[GpsPosition], origin: GpsPosition) -> FloatArray:
    """Return (N, 3) meters east, north and up of an origin; a position without altitude has that of the origin."""
    return _frame(origin)(_coordinates(positions, origin.altitude_m))


def position_from_enu(enu: FloatArray, origin: GpsPosition) -> GpsPosition:
    """Return the position (3,) meters east, north and up of an origin; the inverse of `enu_m`."""
    longitude, latitude, altitude = _frame(origin).positions(enu[None])[0].tolist()
    return GpsPosition(latitude, longitude, None if origin.altitude_m is None else altitude)


def _frame(origin: GpsPosition) -> LocalFrame:
    return LocalFrame(read_system(GPS_SYSTEM), _coordinates([origin], origin.altitude_m)[0])


def _coordinates(positions: Sequence[GpsPosition], altitude_m: float | None) -> FloatArray:
    """Return longitude, latitude and altitude (N, 3); a position without altitude has this one, all if it is None."""
    base = altitude_m or 0.0
    heights = [base if None in (altitude_m, one.altitude_m) else one.altitude_m for one in positions]
    return np.array([(one.longitude_deg, one.latitude_deg, up) for one, up in zip(positions, heights, strict=True)])


def _median_position(positions: Sequence[GpsPosition]) -> GpsPosition:
    altitudes = [position.altitude_m for position in positions if position.altitude_m is not None]
    altitude = float(np.median(altitudes)) if altitudes else None
    longitude, latitude, _ = LocalFrame.around(
        read_system(GPS_SYSTEM), _coordinates(positions, altitude)
    ).origin.tolist()
    return GpsPosition(latitude, longitude, altitude)


def _fit_on_ground(
    cameras: FloatArray, enu: FloatArray, up: FloatArray, given: Sequence[GpsPosition]
) -> Georeference | Rejected:
    axes = perpendicular_basis(up)
    # horizontal components as x + iy
    z, w = (np.asarray(points[:, 0] + 1j * points[:, 1], np.complex128) for points in (cameras @ axes.T, enu))
    spread = float(MAD_TO_SIGMA * np.median(np.abs(w - (np.median(w.real) + 1j * np.median(w.imag)))))
    limit = max(OPTIONS.max_residual_m, OPTIONS.max_residual_share * spread)
    agreeing = _inlier_mask(z, w, limit)
    weights = _weights([one for one, agrees in zip(given, agreeing, strict=True) if agrees])
    a, b = _fit_complex_line(z[agreeing], w[agreeing], weights)
    places = np.unique(np.round(enu[:, :2], 2), axis=0)
    used = len(np.unique(np.round(enu[agreeing, :2], 2), axis=0))
    if used < max(MIN_POSITIONS, OPTIONS.min_share * len(places)):
        return Rejected(f"only {used} of {len(places)} GPS positions agree with the cameras within {limit:.0f} m")
    rms = float(np.sqrt(weights @ np.abs(a * z[agreeing] + b - w[agreeing]) ** 2))
    extent = float(np.sqrt(weights @ np.abs(w[agreeing] - weights @ w[agreeing]) ** 2))
    count = min(used, 1.0 / float(weights @ weights))  # of equal weights (Kish 1965)
    unexplained = min((rms / extent) ** 2, 1.0) if extent > 0 else 1.0
    deviation = np.sqrt(unexplained / max(1.0 - unexplained, 1e-12) / (2 * (count - 2)))
    # for positions unrelated to the cameras, `unexplained` has the distribution function u^(n-2): Beta(n - 2, 1)
    if unexplained ** (count - 2) > OPTIONS.significance or deviation > OPTIONS.max_scale_deviation:
        return Rejected(f"{used} GPS positions of {extent:.0f} m with errors of {rms:.1f} m do not determine a scale")
    scale = float(np.abs(a))
    c = a / scale
    R = np.array([[c.real, -c.imag, 0.0], [c.imag, c.real, 0.0], [0.0, 0.0, 1.0]]) @ np.stack([*axes, up])
    height = float(np.median(enu[:, 2] - scale * cameras @ up))
    fit = Similarity(scale, R, np.array([b.real, b.imag, height]))
    return Georeference(fit, _median_position(given), used, len(places), rms, float(deviation))


def _inlier_mask(z: NDArray[np.complex128], w: NDArray[np.complex128], limit: float) -> BoolArray:
    """Find the inliers of the best pair by truncated squared residuals, then refit until they no longer change."""
    best, least = np.ones(len(z), bool), np.inf
    for pair in draw_pairs(len(z), OPTIONS.max_pairs):
        if abs(w[pair[0]] - w[pair[1]]) < 1e-6 or abs(z[pair[0]] - z[pair[1]]) < 1e-140:  # smaller squares underflow
            continue
        a, b = _fit_complex_line(z[pair], w[pair])
        distance = np.abs(a * z + b - w)
        cost = float(np.minimum(distance, limit) @ np.minimum(distance, limit))
        if cost < least:
            best, least = distance < limit, cost
    for _ in range(5):
        a, b = _fit_complex_line(z[best], w[best])
        refitted = np.abs(a * z + b - w) < limit
        if refitted.sum() < 2 or (refitted == best).all():
            break
        best = refitted
    return best


def _weights(positions: Sequence[GpsPosition]) -> FloatArray:
    """Return weights (N,) of positions by their deviations, with the sum 1; equal ones if only few would count."""
    deviations = [one.deviation_m or OPTIONS.deviation_m for one in positions]
    weights = 1.0 / np.maximum(deviations, OPTIONS.min_deviation_m) ** 2
    weights /= weights.sum()
    few = 1.0 / (weights @ weights) < MIN_POSITIONS + 1
    return np.full(len(weights), 1.0 / len(weights)) if few else np.asarray(weights)


def _fit_complex_line(
    z: NDArray[np.complex128], w: NDArray[np.complex128], weights: FloatArray | None = None
) -> tuple[complex, complex]:
    """Fit a and b of w = a z + b by least squares."""
    middle, target = np.average(z, weights=weights), np.average(w, weights=weights)
    centered = z - middle
    weighted = centered if weights is None else weights * centered
    a = complex(np.vdot(weighted, w - target) / max(float(np.vdot(weighted, centered).real), 1e-300))
    return a, complex(target - a * middle)


def _up_from_positions(
    cameras: FloatArray, enu: FloatArray, positions: Sequence[GpsPosition]
) -> tuple[FloatArray, float] | None:
    """Estimate up (3,) in the world and its deviation in degrees from positions in space; None if it is too large."""
    if any(position.altitude_m is None for position in positions) or len(positions) < 5:
        return None
    try:
        fit = robust_similarity(cameras, enu)
    except FAILURES:  # on a line
        return None
    moved = fit(cameras)
    narrow = np.sqrt(np.linalg.eigvalsh(np.cov(moved.T))[1])
    residual = MAD_TO_SIGMA * np.median(np.linalg.norm(moved - enu, axis=1))
    deviation_deg = float(np.degrees(residual / max(narrow * np.sqrt(len(moved)), 1e-12)))
    return (np.asarray(fit.R[2]), deviation_deg) if deviation_deg < OPTIONS.max_up_deviation_deg else None
