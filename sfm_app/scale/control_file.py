"""Read ground control points from OpenDroneMap's gcp_list.txt.

The first line is the coordinate system: EPSG:32632, a proj string such as "+proj=utm +zone=32 +datum=WGS84", or "WGS84
UTM 32N". Each other line is a mark in a photo: geo_x geo_y geo_z pixel_x pixel_y photo [name]. Marks with one name, or
without names those with one position, are of one point.
"""

import math
import re
from pathlib import Path

from sfm_app.errors import InputError
from sfm_app.hashing import fingerprint
from sfm_app.types import ControlPoint, ControlPoints

FORM = (
    "the first line is a coordinate system such as EPSG:32632, each other one: geo_x geo_y geo_z pixel_x pixel_y photo "
    "[name]"
)
MOST_BYTES = 10_000_000
GEOGRAPHIC = re.compile(r"\+proj=(longlat|latlong)|^EPSG:4326$|^WGS ?84$", re.IGNORECASE)
FEET = re.compile(r"\+units=(us-)?ft|\+to_meter", re.IGNORECASE)


def read_control_points(path: Path) -> ControlPoints:
    """Read a file of ground control points.

    Args:
        path: of the form of OpenDroneMap's gcp_list.txt.

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
