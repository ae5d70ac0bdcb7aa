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

# The file, OpenDroneMap's gcp_list.txt.
# The first line is the coordinate system: EPSG:32632, a proj string such as "+proj=utm +zone=32 +datum=WGS84", or
# "WGS84 UTM 32N". Each other line is a mark in a photo: geo_x geo_y geo_z pixel_x pixel_y photo [name]. Marks with
# the same name, or without names at the same position, belong to one point.

FORM = (
    "the first line is a coordinate system such as EPSG:32632, each other one: geo_x geo_y geo_z pixel_x pixel_y photo "
    "[name]"
)
GEOGRAPHIC = re.compile(r"\+proj=(longlat|latlong)|^EPSG:4326$|^WGS ?84$", re.IGNORECASE)
FEET = re.compile(r"\+units=(us-)?ft|\+to_meter", re.IGNORECASE)


def read_control_points(path: Path) -> ControlPoints:
    """Read a file of ground control points; raise an InputError that names a malformed line."""
    try:
        if path.stat().st_size > 10_000_000:
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
    content = [[one.name, one.position, one.marks] for one in points]
    return ControlPoints(points, crs, geographic, str(path), fingerprint(crs, content))


def _read_marks(lines: list[str], geographic: bool) -> tuple[ControlPoint, ...]:
    names: dict[tuple[object, ...], str] = {}
    positions: dict[str, tuple[float, float, float]] = {}
    marks: dict[str, dict[str, tuple[float, float]]] = {}
    for number, line in enumerate(lines[1:], start=2):
        if not line or line.startswith("#"):
            continue
        try:
            position, mark, photo, name = _read_mark(line, geographic)
        except ValueError as err:
            raise ValueError(f"line {number} {err}") from None
        name = name or names.setdefault(position, f"point {len(names) + 1}")
        if positions.setdefault(name, position) != position:
            raise ValueError(f"line {number} gives '{name}' another position than an earlier line")
        marks.setdefault(name, {})[photo] = mark
    return tuple(ControlPoint(name, positions[name], marks[name]) for name in positions)


def _read_mark(line: str, geographic: bool) -> tuple[tuple[float, float, float], tuple[float, float], str, str]:
    """Return the position, the mark, its photo and the name of the point, which may be empty."""
    words = line.split("\t") if "\t" in line else line.split()
    try:
        east, north, up, x, y = map(float, words[:5])
        photo = words[5].strip()
    except (ValueError, IndexError):
        raise ValueError("is malformed") from None
    on_earth = not geographic or (-180 <= east <= 360 and -90 <= north <= 90)
    if not all(map(math.isfinite, (east, north, up, x, y))) or not on_earth:
        raise ValueError("has a value out of range")
    return (east, north, up), (x, y), photo, words[6].strip() if len(words) > 6 else ""


SIGNIFICANCE = 0.002
"""Probability of a false alarm at each step of the forward search. Chosen by hand; the unit tests count false alarms
and detected wrong points."""
UNKNOWNS = 7
"""Parameters of a similarity. By definition."""
MIN_SIGMA_M = 1e-4
"""Least standard deviation of a control point, in meters. Chosen by hand."""
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
    inliers: tuple[str, ...]
    outliers: Mapping[str, float]
    """Distance of each rejected point from the fit, in meters."""


def fit_control_points(given: ControlPoints, located: Mapping[str, SightedPoint]) -> ControlFit | str:
    """Fit the similarity from the model to control points by their places in it; return the reason if there is none."""
    points = [point for point in given.points if point.name in located]
    if len(points) < 3:
        return f"{len(points)} of {len(given.points)} ground control points have a place in the model, 3 are needed"
    targets, crs, offset = _target_positions(points, given)
    places = np.array([located[point.name].place for point in points])
    try:
        used = agreeing_points(places, targets)
    except FAILURES:
        return "the ground control points lie on a line: they do not determine the up direction"
    fit = umeyama(places[used], targets[used])
    distances = np.linalg.norm(fit(places) - targets, axis=1)
    rms = float(np.sqrt(np.mean(distances[used] ** 2)))
    names = [point.name for point in points]
    inliers = tuple(name for name, inlier in zip(names, used, strict=True) if inlier)
    outliers = {name: float(miss) for name, inlier, miss in zip(names, used, distances, strict=True) if not inlier}
    variances = [np.trace(located[name].covariance) / 3 for name in inliers]
    sigma = max(_sigma(distances[used]), fit.scale * float(np.sqrt(np.mean(variances))), MIN_SIGMA_M)
    spread = float(np.sqrt((np.square(places[used] - places[used].mean(axis=0))).sum()))
    return ControlFit(fit, crs, offset, sigma / (fit.scale * spread), rms, inliers, outliers)


def agreeing_points(places: FloatArray, targets: FloatArray) -> NDArray[np.bool_]:
    """Return which points agree on one similarity; all of fewer than five, which have too little redundancy.

    A forward search (Atkinson and Riani 2000) begins with the four that agree best and adds the nearest one by one. The
    points from some step on are rejected if the fit without them is better than chance allows: by the F-test, with as
    many trials as there are ways to choose the rejected points.
    `places` (N, 3) are in the model, `targets` (N, 3) in meters. A ValueError says that all points lie on a line.
    """
    first = robust_similarity(places, targets)
    if len(places) < 5:
        return np.ones(len(places), bool)
    members = np.argsort(np.linalg.norm(first(places) - targets, axis=1), kind="stable")[:4]
    searched = [members]
    squares = [_squared_error(places[members], targets[members])]
    while len(members) < len(places):
        distances = np.linalg.norm(umeyama(places[members], targets[members])(places) - targets, axis=1)
        members = np.argsort(distances, kind="stable")[: len(members) + 1]
        searched.append(members)
        squares.append(_squared_error(places[members], targets[members]))
    last = len(searched) - 1
    while any(_chance(squares, fewer, last) < SIGNIFICANCE for fewer in range(last)):
        last -= 1
    used = np.zeros(len(places), bool)
    used[searched[last]] = True
    return used


def _chance(squares: Sequence[float], fewer: int, more: int) -> float:
    """Return the probability that inliers alone make the fit of 4 + `more` points so much worse than of 4 + `fewer`."""
    from scipy.stats import f  # takes half a second to load

    extra, freedom = more - fewer, 3 * (fewer + 4) - UNKNOWNS
    ratio = (squares[more] - squares[fewer]) / (3 * extra) / (squares[fewer] / freedom)
    return float(comb(more + 4, extra) * f.sf(ratio, 3 * extra, freedom))


def _squared_error(places: FloatArray, targets: FloatArray) -> float:
    """Return the sum of the squared distances of points to their fit, at least that of the least deviation."""
    residuals = umeyama(places, targets)(places) - targets
    return max(float((residuals**2).sum()), MIN_SIGMA_M**2 * (3 * len(places) - UNKNOWNS))


def _sigma(distances: FloatArray) -> float:
    """Return the standard deviation of each coordinate from the distances to the fit."""
    from scipy.stats import norm, t  # takes half a second to load

    freedom = max(3 * len(distances) - UNKNOWNS, 1)
    # widened for few points, so that three deviations cover as much as three of a normal distribution
    widening = t.ppf(norm.cdf(3.0), freedom) / 3.0
    return float(widening * np.sqrt((distances**2).sum() / freedom))


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
    place = f"{origin.latitude_deg:.8f}, {origin.longitude_deg:.8f}, {origin.altitude_m:.3f}"
    return enu_m(known, origin) @ EAST_UP_SOUTH.T, f"meters east, north and up of {place}", (0.0, 0.0, 0.0)
