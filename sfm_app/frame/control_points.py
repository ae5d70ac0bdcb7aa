"""Ground control points: their file, and the fit of the model to them."""

import contextlib
import math
import mimetypes
import re
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import islice
from math import comb
from pathlib import Path, PurePosixPath

import numpy as np

from sfm_app.errors import InputError
from sfm_app.files import fingerprint, read_text
from sfm_app.frame.coordinates import GPS_SYSTEM, CoordinateSystem, LocalFrame, read_system
from sfm_app.frame.scale import CHECK, LEFT_OUT, USED, SurveyedPoint
from sfm_app.frame.sighted_points import SightedPoint
from sfm_app.geometry.poses import Similarity, robust_similarity, umeyama
from sfm_app.numerical import FAILURES
from sfm_app.types import ControlPoint, ControlPoints, GpsPosition, MapPlace
from sfm_app.types.arrays import BoolArray, FloatArray
from sfm_app.wording import format_length

# The file, OpenDroneMap's gcp_list.txt.
# The first line is the coordinate system: EPSG:32632, a proj string such as "+proj=utm +zone=32 +datum=WGS84", or
# "WGS84 UTM 32N". Each other line is a mark in a photo: geo_x geo_y geo_z pixel_x pixel_y photo [name]. Marks with
# the same name, or without names at the same position, belong to one point. A name that begins with CHK- makes a check
# point: it has no part in the fit.

FORM = (
    "the first line is a coordinate system such as EPSG:32632, or `local` for meters along your own axes; each other "
    "one: geo_x geo_y geo_z pixel_x pixel_y photo [name], with east or longitude first"
)
MOST_BYTES, MOST_WORDS = 10_000_000, 20
"""Largest file, and words of the name of a photo. Chosen by hand."""
SUFFIX = re.compile(r".+?\.[A-Za-z]\w{2,4}(?=\s|$)")
"""The name of a photo, with blanks, up to its suffix."""
ZONE = re.compile(r"(?<=zone[ =])\d+", re.IGNORECASE)
"""Number of a zone of UTM or Gauss-Kruger in the name of a system or in a PROJ string."""


def read_control_points(path: Path, files: Collection[str] = ()) -> ControlPoints:
    """Read a file of ground control points; raise an InputError that names a malformed line.

    `files` are those of the folder of photos, with forward slashes; none of a video.
    """
    try:
        lines = [(number, line.strip()) for number, line in enumerate(read_text(path, MOST_BYTES).splitlines(), 1)]
        lines = [line for line in lines if line[1] and not line[1].startswith("#")]
        system, header = read_header(lines)
        points = _read_marks(lines, system, files)
        if not points:
            raise ValueError("it holds no point")
    except OSError as err:
        hint = f"name the file: {FORM}"
        raise InputError(f"cannot read the ground control points {path}: {err.strerror}", hint=hint) from err
    except ValueError as err:
        raise InputError(f"{path} holds no ground control points: {err}", hint=FORM) from err
    content = [[one.name, one.position, one.marks] for one in points]
    return ControlPoints(points, header, str(path), fingerprint(header, content))


def read_header(lines: list[tuple[int, str]]) -> tuple[CoordinateSystem, str]:
    """Take the coordinate system from numbered lines; WKT may have several. ValueError if PROJ does not know it."""
    if not lines:
        raise ValueError("it names no coordinate system")
    number, header = lines.pop(0)
    while header.count("[") > header.count("]") and lines:
        header += lines.pop(0)[1]
    if re.match(r"([-+]?\d[\d.,]*[\s;,]+){3}", header):
        raise ValueError(f"line {number} is a mark, where the coordinate system must stand: insert a line above it")
    try:
        return read_system(header), header
    except ValueError as err:
        raise ValueError(f"line {number}: {err}") from None


Position = tuple[float, float, float]


def _read_marks(
    lines: Sequence[tuple[int, str]], system: CoordinateSystem, files: Collection[str]
) -> tuple[ControlPoint, ...]:
    index, missing = index_files(files), list[str]()
    names: dict[Position, str] = {}
    positions: dict[str, Position] = {}
    marks: dict[str, dict[str, tuple[float, float]]] = {}
    for number, line in lines:
        try:
            position, mark, tails = _read_mark(line)
            photo, name, is_there = find_photo(tails, index)
        except ValueError as err:
            raise ValueError(f"line {number} {err}") from None
        name = name or names.setdefault(position, f"point {len(names) + 1}")
        if name not in positions:
            check_position(position, system, number)
        if positions.setdefault(name, position) != position:
            raise ValueError(f"line {number} gives '{name}' another position than an earlier line")
        marks.setdefault(name, {})[photo] = mark
        missing += [] if is_there else [f"line {number} names the photo '{photo}', which the folder does not have"]
    if files and lines and len(missing) == len(lines):
        raise ValueError(missing[0])
    return tuple(ControlPoint(name, positions[name], marks[name]) for name in positions)


def _read_mark(line: str) -> tuple[Position, tuple[float, float], list[tuple[str, str]]]:
    """Return the position, the mark, and each way to divide the rest into a photo and the name of the point."""
    divider = next((sign for sign in "\t;," if line.count(sign) >= 5), None)
    words = line.split(divider, 5)
    try:
        x, y, z, column, row = map(float, words[:5])
        tail = words[5].strip()
    except (ValueError, IndexError):
        raise ValueError("is malformed") from None
    if not all(map(math.isfinite, (x, y, z, column, row))):
        raise ValueError("has a value out of range")
    if divider is not None:
        photo, _, name = tail.partition(divider)
        return (x, y, z), (column, row), [(photo.strip(), name.partition(divider)[0].strip())]
    gaps = islice(re.finditer(r"\s+|$", tail), MOST_WORDS)
    tails = [(tail[: gap.start()], (tail[gap.end() :].split(maxsplit=1) or [""])[0]) for gap in gaps]
    return (x, y, z), (column, row), tails[::-1]


def check_position(position: Position, system: CoordinateSystem, line: int) -> None:
    """Raise a ValueError if a system has no such position; it says whether swapped columns would be one."""
    x, y, z = position
    there, swapped = np.isfinite(system.geocentric_m(np.array([[x, y, z], [y, x, z]]))[:, 0])
    if not there:
        advice = "; longitude or east comes first: swap them" if swapped else ""
        raise ValueError(f"line {line} has a position out of range of the system {system.name}{advice}")


def index_files(files: Collection[str]) -> tuple[dict[str, list[str]], ...]:
    """Return files by what users may call them: path, name, name in other case, the same without suffix."""
    index: tuple[dict[str, list[str]], ...] = ({}, {}, {}, {})
    for file in files:
        path = PurePosixPath(file)
        is_picture = (mimetypes.guess_type(file)[0] or "").startswith("image/")  # no sidecar
        keys = [file, path.name, path.name.casefold(), path.stem.casefold() if is_picture else file]
        for known, key in zip(index, keys, strict=True):
            known.setdefault(key, []).append(file)
    return index


def find_photo(tails: Sequence[tuple[str, str]], index: Sequence[Mapping[str, Sequence[str]]]) -> tuple[str, str, bool]:
    """Return the photo of a mark, the name of its point, and whether the photo is a file of the folder.

    `tails` are pairs of both, the longest photo first. A ValueError says that several photos fit equally well.
    """
    for level, known in enumerate(index):
        fits: dict[str, str] = {}
        for photo, point in tails:
            name = photo.replace("\\", "/").rpartition("/")[2] if level else photo
            for file in known.get(name.casefold() if level > 1 else name, ()):
                fits.setdefault(file, point)
        if len(fits) > 1:
            raise ValueError(f"may mean {' or '.join(sorted(fits))}: write the path of the photo")
        if fits:
            return (*fits.popitem(), True)
    suffixed = SUFFIX.match(tails[0][0])
    photo, point = next((one for one in tails if suffixed and one[0] == suffixed[0]), tails[-1])
    return photo, point, False


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
    """To x east, y up and z south of the place, in meters; x and z may follow a grid."""
    deviation: float
    """Relative standard deviation of the scale."""
    rms_m: float
    inliers: tuple[str, ...]
    outliers: Mapping[str, float]
    """Distance of each rejected point from the fit, in meters."""
    place: MapPlace
    surveyed: tuple[SurveyedPoint, ...] = ()
    """All located points, check points included."""


def fit_control_points(
    given: ControlPoints, located: Mapping[str, SightedPoint], shape: float = 0.0
) -> ControlFit | str:
    """Fit the similarity from the model to control points by their places in it; return the reason if there is none.

    Check points have no part in the fit. `shape` is the relative deviation of the model's proportions.
    """
    used_for_fit = [point for point in given.points if not point.is_check]
    points = [point for point in used_for_fit if point.name in located]
    if len(points) < 3:
        return f"{len(points)} of {len(used_for_fit)} ground control points have a place in the model, 3 are needed"
    sights = [located[point.name] for point in points]
    placed = _place(read_system(given.crs), np.array([point.position for point in points]), sights)
    if placed is None:
        return "the ground control points lie on a line: they do not determine the up direction"
    frame, used, distances, fit = placed.frame, placed.used, placed.distances, placed.fit
    names = [point.name for point in points]
    inliers = tuple(name for name, inlier in zip(names, used, strict=True) if inlier)
    outliers = {name: float(miss) for name, inlier, miss in zip(names, used, distances, strict=True) if not inlier}
    marks = fit.scale * _mark_deviation([located[name] for name in inliers])
    deviation = max(_sigma(distances[used]), marks, MIN_SIGMA_M) / float(np.sqrt(used.sum())) / placed.spread(used)
    x, y, z = frame.origin.tolist()
    surveyed = tuple(
        _compare(point, located[point.name], placed, shape, USED if point.name in inliers else LEFT_OUT)
        for point in given.points
        if point.name in located
    )
    return ControlFit(fit, deviation, placed.miss(used), inliers, outliers, MapPlace(given.crs, (x, y, z)), surveyed)


def _compare(point: ControlPoint, sight: SightedPoint, placed: "_Placed", shape: float, role: str) -> SurveyedPoint:
    """Return how far a located point is off, and for a check point, how far it may be."""
    target = placed.frame(np.array([point.position]))[0] @ EAST_UP_SOUTH.T
    x, y, z = placed.fit(sight.place) - target
    residuals = float(np.hypot(x, z)), float(y)
    if not point.is_check:
        return SurveyedPoint(point.name, role, len(sight.photos), *residuals)
    variance = np.diag(_prediction_covariance(target, sight, placed, shape))
    deviations = float(np.sqrt(variance[0] + variance[2])), float(np.sqrt(variance[1]))
    return SurveyedPoint(point.name, CHECK, len(sight.photos), *residuals, *deviations)


def _prediction_covariance(target: FloatArray, sight: SightedPoint, placed: "_Placed", shape: float) -> FloatArray:
    """Return the covariance (3, 3) in m^2 of the residual of a point that has no part in the fit.

    It adds the point's marks, which are no better than those of the fit; what the residuals of the fit have beyond
    their marks, which is the survey and the model; the seven parameters of the fit; and the camera, since a wrong focal
    bends depths against widths.
    """
    fitted = [one for one, used in zip(placed.sights, placed.used, strict=True) if used]
    marks_m, typical_px = placed.fit.scale * _mark_deviation(fitted), np.median([one.sigma_px for one in fitted])
    sigma = max(_sigma(placed.distances[placed.used]), marks_m, MIN_SIGMA_M)
    others = max(sigma**2 - marks_m**2, MIN_SIGMA_M**2)
    middle = placed.targets[placed.used].mean(axis=0)
    jacobians = [_similarity_jacobian(one - middle) for one in placed.targets[placed.used]]
    parameters = np.linalg.inv(sum(one.T @ one for one in jacobians))
    here, turn = _similarity_jacobian(target - middle), placed.fit.scale * placed.fit.R
    marks = max(typical_px / sight.sigma_px, 1.0) ** 2 * sight.covariance
    bent = shape * (target - middle)
    covariance = turn @ marks @ turn.T + others * np.eye(3) + sigma**2 * here @ parameters @ here.T
    return np.asarray(covariance + np.outer(bent, bent))


def _similarity_jacobian(place: FloatArray) -> FloatArray:
    """Return the derivatives (3, 7) of a place (3,) by translation, rotation and scale."""
    return np.column_stack([np.eye(3), np.cross(np.eye(3), place), place])


@dataclass(frozen=True, slots=True, eq=False)
class _Placed:
    """A model placed on positions."""

    frame: LocalFrame
    targets: FloatArray
    """(N, 3) positions as x east, y up and z south in the frame, in meters."""
    used: BoolArray
    fit: Similarity
    distances: FloatArray
    """(N,) from the targets, in meters."""
    sights: Sequence[SightedPoint]

    def miss(self, rows: BoolArray | slice = slice(None)) -> float:
        """Return the root mean square of distances."""
        return float(np.sqrt(np.mean(self.distances[rows] ** 2)))

    def spread(self, rows: BoolArray | slice = slice(None)) -> float:
        """Return the root mean square of the distances of targets from their middle."""
        return float(np.sqrt(self.targets[rows].var(axis=0).sum()))


def _place(system: CoordinateSystem, positions: FloatArray, sights: Sequence[SightedPoint]) -> _Placed | None:
    """Fit the similarity from the model to positions (N, 3); None if they do not determine it."""
    places = np.array([one.place for one in sights])
    try:
        frame = LocalFrame.around(system, positions)
        targets = frame(positions) @ EAST_UP_SOUTH.T
        used = agreeing_points(places, targets)
    except FAILURES:
        return None
    fit = umeyama(places[used], targets[used])
    return _Placed(frame, targets, used, fit, np.linalg.norm(fit(places) - targets, axis=1), sights)


def _mark_deviation(sights: Sequence[SightedPoint]) -> float:
    """Return the standard deviation of a coordinate in the model by the marks of points."""
    return float(np.sqrt(np.mean([np.trace(one.covariance) / 3 for one in sights])))


def agreeing_points(places: FloatArray, targets: FloatArray) -> BoolArray:
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


# Mistakes that explain why points fit badly, or lie in another place than the photos.


class MISTAKES:
    """Constants of the search for mistakes, chosen by hand."""

    max_share: float = 0.01
    """Largest miss of sound points, as a share of their spread."""
    max_deviations: float = 5.0
    """The same in standard deviations of the marks; only a miss above both is too large."""
    max_outliers: float = 0.34
    """Largest share of rejected points."""
    min_gain: float = 3.0
    """Least factor by which correcting a mistake reduces misses that are too large."""
    max_degrees: float = 3.0
    """How far points may lie outside of the area of their system: half a zone of UTM."""
    max_away_m: float = 5000.0
    """How far points may lie from the GPS positions of the photos."""


def find_mistake(
    given: ControlPoints, located: Mapping[str, SightedPoint], gps: Sequence[GpsPosition]
) -> tuple[str, bool]:
    """Return what is probably wrong with the file, empty if nothing is, and whether the points are unusable.

    Each plausible mistake is corrected, and the misses are compared. `gps` has the positions of the photos.
    """
    points = [point for point in given.points if point.name in located and not point.is_check]
    sights = [located[point.name] for point in points]
    system, positions = read_system(given.crs), np.array([point.position for point in points])
    now = _place(system, positions, sights)
    symptom = "" if now is None else _symptom(now, sights, gps)
    if now is None or not symptom:
        return "", False
    share, causes = now.miss() / now.spread(), list[tuple[float, str, bool]]()
    largest = share / MISTAKES.min_gain if symptom.startswith(MISS) else 1.5 * share + MISTAKES.max_share / 3
    for mistake, keeps_shape, other, corrected in _plausible_mistakes(system, positions):
        then = _place(other, corrected, sights)
        if then is not None and then.miss() < largest * then.spread() and not _symptom(then, sights, gps):
            text = f"probably because {mistake}: if so, they miss by {format_length(then.miss())}; correct the file"
            causes.append((then.miss() / then.spread(), text, keeps_shape))
    if not causes and symptom == UPSIDE_DOWN:  # the model's up may be wrong
        return "", False
    _, cause, keeps_shape = min(causes, default=(0.0, "check the coordinate system and the order of the columns", True))
    return f"the ground control points {symptom}, {cause}", not keeps_shape


MISS, UPSIDE_DOWN = "miss their places", "turn the model upside down"


def _plausible_mistakes(
    system: CoordinateSystem, positions: FloatArray
) -> Iterator[tuple[str, bool, CoordinateSystem, FloatArray]]:
    """Yield a mistake, whether it leaves lengths as they are, and the corrected system and positions."""
    pair = "latitude and longitude" if system.crs.is_geographic else "x and y"
    yield f"{pair} are swapped", False, system, positions[:, [1, 0, 2]]
    if system.z_m != 1.0 and not system.has_heights:
        yield "heights are in meters", False, system, positions / [1.0, 1.0, system.z_m]
    if zone := ZONE.search(system.title):
        for other in (int(zone[0]) - 1, int(zone[0]) + 1):
            with contextlib.suppress(ValueError):
                neighbor = read_system(ZONE.sub(str(other), system.title, count=1))
                yield f"the zone is {other}", True, neighbor, positions


def _symptom(placed: _Placed, sights: Sequence[SightedPoint], gps: Sequence[GpsPosition]) -> str:
    """Return what is wrong with placed points, for people; empty if nothing is."""
    system, used = placed.frame.system, placed.used
    sigma = placed.fit.scale * _mark_deviation(sights)
    largest = max(MISTAKES.max_share * placed.spread(), MISTAKES.max_deviations * sigma)
    if placed.miss(used) > largest or np.mean(~used) > MISTAKES.max_outliers:
        return f"{MISS} by {format_length(placed.miss())}"
    outside = system.degrees_outside(placed.frame.center)
    if outside > MISTAKES.max_degrees:
        return f"lie {outside:.0f} degrees outside of the area of {system.name}"
    if gps and not system.is_flat:
        photos = [[one.longitude_deg, one.latitude_deg, one.altitude_m or 0.0] for one in gps]
        middle = np.median(read_system(GPS_SYSTEM).geocentric_m(np.array(photos)), axis=0)
        away = float(np.linalg.norm(middle - placed.frame.center))
        if away > MISTAKES.max_away_m:
            return f"lie {format_length(away)} from the GPS positions of the photos"
    return UPSIDE_DOWN if placed.fit.R[1, 1] < 0 and not system.is_flat else ""
