"""Place, heading and scale of a reconstruction on Earth, from the GPS positions of its photos."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from sfm_app.geometry.poses import Similarity, perpendicular_basis, robust_similarity
from sfm_app.numerical import FAILURES, MAD_TO_SIGMA
from sfm_app.types import GpsPosition
from sfm_app.types.arrays import FloatArray

EQUATOR_M, FLATTENING = 6378137.0, 1.0 / 298.257223563
"""WGS84."""

GPS_M, GPS_SHARE = 10.0, 0.15
"""Largest residual that consumer GPS explains: in meters, or as a share of the spread of the photos if that is more."""

SIGNIFICANCE = 1e-3
"""Largest probability that positions unrelated to the cameras fit as well."""

SCALE_DEVIATION = 0.1
"""Largest relative standard deviation of the scale."""

LEAST_PHOTOS, LEAST_SHARE = 3, 0.6
"""Least number of distinct positions, and their least share, that must agree."""

MAX_UP_DEVIATION_DEG = 2.0
"""Largest standard deviation, in degrees, with which up from GPS replaces up from the cameras' roll."""

MAX_PAIRS = 500


@dataclass(frozen=True, slots=True, eq=False)
class Georeference:
    """The similarity from the reconstruction to meters on the ground."""

    enu_from_world: Similarity
    """To meters east, north and up of `origin`."""
    origin: GpsPosition
    """Position of (0, 0, 0) in that frame; without altitude, heights are relative to the cameras' median height."""
    photos: int
    """Number of distinct positions that agree."""
    of: int
    """Number of distinct positions."""
    rms_m: float
    """Root mean square horizontal residual of the agreeing positions."""
    scale_deviation: float
    """Relative standard deviation of the scale."""
    up_deviation_deg: float | None = None
    """Standard deviation of up if it comes from the positions and their altitudes; None if up was given."""


@dataclass(frozen=True, slots=True)
class NoGeoreference:
    """Why the positions are not used. Falsy, so that ``if found:`` reads well."""

    reason: str

    def __bool__(self) -> bool:
        return False


def georeference(
    centers: FloatArray, positions: Sequence[GpsPosition | None], up: FloatArray, *, up_is_sure: bool = True
) -> Georeference | NoGeoreference:
    """Find scale, heading and place from the positions of the photos, if these agree with the cameras.

    GPS is off by 3 to 10 m horizontally and by twice that in height, so the given up is kept and only the horizontal
    positions are used: w = a z + b in complex numbers, by RANSAC over pairs, then least squares. Only if up is unsure
    and the positions determine it well in space, up is taken from them.

    Args:
        centers: (N, 3) camera centers.
        positions: per photo; None if it has none.
        up: (3,) unit vector in the world.
    """
    known = [k for k, position in enumerate(positions) if position is not None]
    given = [position for position in positions if position is not None]
    if not given:
        return NoGeoreference("the photos have no positions")
    if len(set(given)) < LEAST_PHOTOS:
        return NoGeoreference(f"{len(set(given))} different positions, {LEAST_PHOTOS} are needed")
    origin = _median_position(given)
    enu, cameras = enu_m(given, origin), centers[known]
    level = _fit_on_ground(cameras, enu, up, origin)
    if up_is_sure and level:
        return level
    other = _up_from_positions(cameras, enu, given)
    tilted = _fit_on_ground(cameras, enu, other[0], origin) if other else level
    return replace(tilted, up_deviation_deg=other[1]) if other and isinstance(tilted, Georeference) else level


def enu_m(positions: Sequence[GpsPosition], origin: GpsPosition) -> FloatArray:
    """Return (N, 3) meters east, north and up of an origin; up is 0 where either altitude is unknown.

    First-order in the angles, with the ellipsoid's radii at the origin: the error is 1 m over 5 km.

    Args:
        origin: where (0, 0, 0) is.
    """
    meridian, parallel = _radii_m(origin)
    turn = [(position.longitude_deg - origin.longitude_deg + 180.0) % 360.0 - 180.0 for position in positions]
    east = parallel * np.radians(turn)
    north = meridian * np.radians([position.latitude_deg - origin.latitude_deg for position in positions])
    here = origin.altitude_m
    above = [
        0.0 if here is None or position.altitude_m is None else position.altitude_m - here for position in positions
    ]
    return np.column_stack([east, north, above])


def position_from_enu(enu: FloatArray, origin: GpsPosition) -> GpsPosition:
    """Return the position at an offset in meters from an origin; the inverse of `enu_m`.

    Args:
        enu: (3,) meters east, north and up.
        origin: where (0, 0, 0) is.
    """
    meridian, parallel = _radii_m(origin)
    longitude = (origin.longitude_deg + float(np.degrees(enu[0] / parallel)) + 180.0) % 360.0 - 180.0
    altitude = None if origin.altitude_m is None else origin.altitude_m + float(enu[2])
    return GpsPosition(origin.latitude_deg + float(np.degrees(enu[1] / meridian)), longitude, altitude)


def _radii_m(origin: GpsPosition) -> tuple[float, float]:
    """Return the radius of curvature along the meridian and the radius of the parallel, at the origin's altitude."""
    latitude = np.radians(origin.latitude_deg)
    squared = FLATTENING * (2.0 - FLATTENING)
    across = EQUATOR_M / np.sqrt(1.0 - squared * np.sin(latitude) ** 2)
    meridian = across * (1.0 - squared) / (1.0 - squared * np.sin(latitude) ** 2)
    height = origin.altitude_m or 0.0
    return float(meridian + height), float(max((across + height) * np.cos(latitude), 1.0))


def _median_position(positions: Sequence[GpsPosition]) -> GpsPosition:
    """Return the median position; its altitude is the median of the known ones."""
    first = positions[0].longitude_deg
    turn = np.median([(position.longitude_deg - first + 180.0) % 360.0 - 180.0 for position in positions])
    longitude = (first + float(turn) + 180.0) % 360.0 - 180.0
    altitudes = [position.altitude_m for position in positions if position.altitude_m is not None]
    latitude = float(np.median([position.latitude_deg for position in positions]))
    return GpsPosition(latitude, longitude, float(np.median(altitudes)) if altitudes else None)


def _fit_on_ground(
    cameras: FloatArray, enu: FloatArray, up: FloatArray, origin: GpsPosition
) -> Georeference | NoGeoreference:
    axes = perpendicular_basis(up)
    z, w = _to_complex(cameras @ axes.T), _to_complex(enu)
    spread = float(MAD_TO_SIGMA * np.median(np.abs(w - (np.median(w.real) + 1j * np.median(w.imag)))))
    limit = max(GPS_M, GPS_SHARE * spread)
    agreeing = _inlier_mask(z, w, limit)
    a, b = _fit_complex_line(z[agreeing], w[agreeing])
    places = np.unique(np.round(enu[:, :2], 2), axis=0)
    used = len(np.unique(np.round(enu[agreeing, :2], 2), axis=0))
    if used < max(LEAST_PHOTOS, LEAST_SHARE * len(places)):
        return NoGeoreference(f"only {used} of {len(places)} GPS positions agree with the cameras within {limit:.0f} m")
    rms = float(np.sqrt(np.mean(np.abs(a * z[agreeing] + b - w[agreeing]) ** 2)))
    extent = float(np.std(w[agreeing]))
    unexplained = min((rms / extent) ** 2, 1.0) if extent > 0 else 1.0
    deviation = np.sqrt(unexplained / max(1.0 - unexplained, 1e-12) / (2 * (used - 2)))
    # for positions unrelated to the cameras, `unexplained` has the distribution function u^(n-2): Beta(n - 2, 1)
    if unexplained ** (used - 2) > SIGNIFICANCE or deviation > SCALE_DEVIATION:
        return NoGeoreference(
            f"{used} GPS positions that spread over {extent:.0f} m and miss the cameras by {rms:.1f} m "
            "do not determine a scale"
        )
    scale = float(np.abs(a))
    turn = a / scale
    R = np.array([[turn.real, -turn.imag, 0.0], [turn.imag, turn.real, 0.0], [0.0, 0.0, 1.0]]) @ np.stack([*axes, up])
    height = float(np.median(enu[:, 2] - scale * cameras @ up))
    fit = Similarity(scale, R, np.array([b.real, b.imag, height]))
    return Georeference(fit, origin, used, len(places), rms, float(deviation))


def _to_complex(points: FloatArray) -> NDArray[np.complex128]:
    """Return the horizontal components of points (N, 2 or 3) as x + iy."""
    return np.asarray(points[:, 0] + 1j * points[:, 1], np.complex128)


def _inlier_mask(z: NDArray[np.complex128], w: NDArray[np.complex128], limit: float) -> NDArray[np.bool_]:
    """Find the inliers of the best pair by truncated squared residuals, then refit until they no longer change."""
    pairs = np.array(list(combinations(range(len(z)), 2)), np.intp)
    if len(pairs) > MAX_PAIRS:
        pairs = np.random.default_rng(0).permutation(pairs)[:MAX_PAIRS]
    best, least = np.ones(len(z), bool), np.inf
    for pair in pairs:
        if abs(w[pair[0]] - w[pair[1]]) < 1e-6 or abs(z[pair[0]] - z[pair[1]]) < 1e-140:  # squares of less are zero
            continue
        a, b = _fit_complex_line(z[pair], w[pair])
        distance = np.abs(a * z + b - w)
        cost = float(np.minimum(distance, limit) @ np.minimum(distance, limit))
        if cost < least:
            best, least = distance < limit, cost
    for _ in range(5):
        a, b = _fit_complex_line(z[best], w[best])
        after = np.abs(a * z + b - w) < limit
        if after.sum() < 2 or (after == best).all():
            break
        best = after
    return best


def _fit_complex_line(z: NDArray[np.complex128], w: NDArray[np.complex128]) -> tuple[complex, complex]:
    """Fit a and b of w = a z + b by least squares."""
    around = z - z.mean()
    a = complex(np.vdot(around, w - w.mean()) / max(float(np.vdot(around, around).real), 1e-300))
    return a, complex(w.mean() - a * z.mean())


def _up_from_positions(
    cameras: FloatArray, enu: FloatArray, positions: Sequence[GpsPosition]
) -> tuple[FloatArray, float] | None:
    """Estimate up (3,) in the world and its deviation from positions in space.

    None if it is not within `MAX_UP_DEVIATION_DEG`.
    """
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
    return (np.asarray(fit.R[2]), deviation_deg) if deviation_deg < MAX_UP_DEVIATION_DEG else None
