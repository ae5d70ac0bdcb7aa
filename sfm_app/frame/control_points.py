"""Ground control points: their file, and the fit of the model to them."""

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import comb
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sfm_app.errors import InputError
from sfm_app.files import fingerprint
from sfm_app.frame.georeference import enu_m, position_from_enu
from sfm_app.frame.sighted_points import SightedPoint
from sfm_app.geometry.poses import Similarity, robust_similarity, umeyama
from sfm_app.numerical import FAILURES
from sfm_app.types import ControlPoint, ControlPoints, GpsPosition
from sfm_app.types.arrays import FloatArray

# Read ground control points from OpenDroneMap's gcp_list.txt.
#
# The first line is the coordinate system: EPSG:32632, a proj string such as "+proj=utm +zone=32 +datum=WGS84", or
# "WGS84 UTM 32N". Each other line is a mark in a photo: geo_x geo_y geo_z pixel_x pixel_y photo [name]. Marks with
# one name, or without names those with one position, are of one point.

FORM = (
    "the first line is a coordinate system such as EPSG:32632, each other one: geo_x geo_y geo_z pixel_x pixel_y photo "
    "[name]"
)
MOST_BYTES = 10_000_000
GEOGRAPHIC = re.compile(r"\+proj=(longlat|latlong)|^EPSG:4326$|^WGS ?84$", re.IGNORECASE)
FEET = re.compile(r"\+units=(us-)?ft|\+to_meter", re.IGNORECASE)


def read_control_points(path: Path) -> ControlPoints:
    """Read a file of ground control points.

    Raises:
        InputError: it cannot be read, or a line of it is malformed; the message names the line.
    """
    try:
        if path.stat().st_size > MOST_BYTES:
            raise ValueError("it is larger than 10 MB")
        lines = [line.strip() for line in path.read_text(encoding="utf-8-sig").splitlines()]
        crs = lines[0] if lines else ""
        if not crs or crs.startswith("#"):
            raise ValueError("its first line names no coordinate system")
        if FEET.search(crs):
            raise ValueError("its coordinate system is not in meters")
        geographic = GEOGRAPHIC.search(crs) is not None
        points = _read_marks(lines, geographic)
        if not points:
            raise ValueError("it holds no point")
    except OSError as err:
        hint = f"name the file: {FORM}"
        raise InputError(f"cannot read the ground control points {path}: {err.strerror}", hint=hint) from err
    except ValueError as err:
        raise InputError(f"{path} holds no ground control points: {err}", hint=FORM) from err
    known = [[one.name, one.position, one.marks] for one in points]
    return ControlPoints(points, crs, geographic, str(path), fingerprint(crs, known))


def _read_marks(lines: list[str], geographic: bool) -> tuple[ControlPoint, ...]:
    """Return the points of all lines but the first; ValueError names a malformed line."""
    names: dict[tuple[object, ...], str] = {}
    positions: dict[str, tuple[float, float, float]] = {}
    marks: dict[str, dict[str, tuple[float, float]]] = {}
    for number, line in enumerate(lines[1:], start=2):
        if not line or line.startswith("#"):
            continue
        words = line.split("\t") if "\t" in line else line.split()
        try:
            east, north, up, x, y = map(float, words[:5])
            photo = words[5].strip()
        except (ValueError, IndexError):
            raise ValueError(f"line {number} is malformed") from None
        if not all(map(math.isfinite, (east, north, up, x, y))) or (geographic and not _is_on_earth(east, north)):
            raise ValueError(f"line {number} has a value out of range")
        given = words[6].strip() if len(words) > 6 else ""
        name = given or names.setdefault((east, north, up), f"point {len(names) + 1}")
        if positions.setdefault(name, (east, north, up)) != (east, north, up):
            raise ValueError(f"line {number} gives '{name}' another position than an earlier line")
        marks.setdefault(name, {})[photo] = (x, y)
    return tuple(ControlPoint(name, positions[name], marks[name]) for name in positions)


def _is_on_earth(longitude: float, latitude: float) -> bool:
    return -180 <= longitude <= 360 and -90 <= latitude <= 90


# Place and size of a model from ground control points, without those that contradict the others.

LEAST_POINTS = 3
CHECKED_POINTS = 5
"""Points from which on a wrong one can be told: four others determine the seven numbers with five left over."""
SIGNIFICANCE = 0.002
"""Probability of a false alarm at each step. Chosen by hand; `tests/unit/scale/test_control_fit.py` counts those, and
the wrong points that are found."""
UNKNOWNS = 7
"""Of a similarity."""
LEAST_SIGMA_M = 1e-4
"""Least standard deviation of a control point, in meters: nobody measures better."""
EAST_UP_SOUTH = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
"""From east, north, up to x, y, z of exported files, with y up."""


@dataclass(frozen=True, slots=True, eq=False)
class ControlFit:
    """A model placed on ground control points."""

    from_model: Similarity
    """To x east, y up and z south of the offset, in meters."""
    crs: str
    offset: tuple[float, float, float]
    """East, north and up of (0, 0, 0)."""
    deviation: float
    """Relative standard deviation of the scale."""
    rms_m: float
    """Root mean square distance of the used points."""
    used: tuple[str, ...]
    wrong: Mapping[str, float]
    """Distance in meters by which each left-out point misses the fit."""


def fit_control_points(given: ControlPoints, located: Mapping[str, SightedPoint]) -> ControlFit | str:
    """Fit the similarity that takes the model to its ground control points, or say why there is none."""
    points = [point for point in given.points if point.name in located]
    if len(points) < LEAST_POINTS:
        return f"{len(points)} of {len(given.points)} ground control points have a place in the model, 3 are needed"
    targets, crs, offset = _target_positions(points, given)
    places = np.array([located[point.name].place for point in points])
    try:
        used = agreeing_points(places, targets)
    except FAILURES:
        return "the ground control points lie on a line: they do not determine which way is up"
    fit = umeyama(places[used], targets[used])
    off = np.linalg.norm(fit(places) - targets, axis=1)
    rms = float(np.sqrt(np.mean(off[used] ** 2)))
    marked = [np.trace(located[point.name].covariance) / 3 for point, kept in zip(points, used, strict=True) if kept]
    sigma = max(_sigma(off[used]), fit.scale * float(np.sqrt(np.mean(marked))), LEAST_SIGMA_M)
    spread = float(np.sqrt((np.square(places[used] - places[used].mean(axis=0))).sum()))
    names = [point.name for point in points]
    return ControlFit(
        fit,
        crs,
        offset,
        sigma / (fit.scale * spread),
        rms,
        tuple(name for name, kept in zip(names, used, strict=True) if kept),
        {name: float(miss) for name, kept, miss in zip(names, used, off, strict=True) if not kept},
    )


def agreeing_points(places: FloatArray, targets: FloatArray) -> NDArray[np.bool_]:
    """Return which points agree on one similarity; all of them where fewer than `CHECKED_POINTS` are given.

    A forward search (Atkinson and Riani 2000) begins with the four that agree best and adds the nearest one by one. A
    point is left out where the fit without it, or without it and those added later, is better than chance allows: by
    the F-test, with as many trials as there are ways to choose those left out.

    Args:
        places: (N, 3) in the model.
        targets: (N, 3) where they should be, in meters.

    Raises:
        ValueError: all lie on a line.
    """
    first = robust_similarity(places, targets)
    if len(places) < CHECKED_POINTS:
        return np.ones(len(places), bool)
    members = np.argsort(np.linalg.norm(first(places) - targets, axis=1), kind="stable")[:4]
    searched = [members]
    squares = [_squared_error(places[members], targets[members])]
    while len(members) < len(places):
        off = np.linalg.norm(umeyama(places[members], targets[members])(places) - targets, axis=1)
        members = np.argsort(off, kind="stable")[: len(members) + 1]
        searched.append(members)
        squares.append(_squared_error(places[members], targets[members]))
    last = len(searched) - 1
    while any(_chance(squares, fewer, last) < SIGNIFICANCE for fewer in range(last)):
        last -= 1
    used = np.zeros(len(places), bool)
    used[searched[last]] = True
    return used


def _chance(squares: Sequence[float], fewer: int, more: int) -> float:
    """Return the probability that good points alone make the fit so much worse, from four points plus either count."""
    from scipy.stats import f  # takes half a second to load

    extra, freedom = more - fewer, 3 * (fewer + 4) - UNKNOWNS
    ratio = (squares[more] - squares[fewer]) / (3 * extra) / (squares[fewer] / freedom)
    return float(comb(more + 4, extra) * f.sf(ratio, 3 * extra, freedom))


def _squared_error(places: FloatArray, targets: FloatArray) -> float:
    """Return the squared distances of points to their fit, as large as the least deviation at least."""
    off = umeyama(places, targets)(places) - targets
    return max(float((off**2).sum()), LEAST_SIGMA_M**2 * (3 * len(places) - UNKNOWNS))


def _sigma(off: FloatArray) -> float:
    """Return the standard deviation of each coordinate of points from their distances to the fit."""
    from scipy.stats import norm, t  # takes half a second to load

    freedom = max(3 * len(off) - UNKNOWNS, 1)
    # a deviation from few numbers may be too small: three of it are to cover as much as of a normal distribution
    few = t.ppf(norm.cdf(3.0), freedom) / 3.0
    return float(few * np.sqrt((off**2).sum() / freedom))


def _target_positions(
    points: Sequence[ControlPoint], given: ControlPoints
) -> tuple[FloatArray, str, tuple[float, float, float]]:
    """Return the positions (N, 3) in the frame of exported files, their coordinate system, and the frame's origin."""
    positions = np.array([point.position for point in points])
    if not given.geographic:
        offset = np.round(positions.mean(axis=0))
        east, north, up = map(float, offset)
        return (positions - offset) @ EAST_UP_SOUTH.T, given.crs, (east, north, up)
    known = [GpsPosition(latitude, longitude, height) for longitude, latitude, height in positions.tolist()]
    middle = GpsPosition(*(float(value) for value in np.median(positions, axis=0)[[1, 0, 2]]))
    origin = position_from_enu(np.zeros(3), middle)
    where = (
        f"meters east, north and up of {origin.latitude_deg:.8f}, {origin.longitude_deg:.8f}, {origin.altitude_m:.3f}"
    )
    return enu_m(known, origin) @ EAST_UP_SOUTH.T, where, (0.0, 0.0, 0.0)
