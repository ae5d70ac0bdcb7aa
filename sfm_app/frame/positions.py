"""Positions of photos from a file: OpenDroneMap's geo.txt, or a table of Metashape or RealityCapture."""

import math
import re
from collections.abc import Collection, Sequence
from pathlib import Path

import numpy as np

from sfm_app.errors import InputError
from sfm_app.files import read_text
from sfm_app.frame.control_points import (
    MISTAKES,
    MOST_BYTES,
    MOST_WORDS,
    check_position,
    find_photo,
    index_files,
    read_header,
)
from sfm_app.frame.coordinates import GPS_SYSTEM, CoordinateSystem, read_system
from sfm_app.types import GpsPosition
from sfm_app.types.photos import FILE

GEO_TXT = "geo.txt"
FORM = (
    "the first line is a coordinate system such as EPSG:4326; each other one: photo x y [z [omega phi kappa "
    "[horizontal and vertical deviation in meters]]], with east or longitude first"
)
DIVIDERS = re.compile(r'[\t;,"]+')
COUNTS = (2, 3, 6, 8)
"""How many numbers may follow the name of a photo."""
TITLES = re.compile(
    r"#?\s*\"?(?:label|name|image|photo|file)[^,;\t]*[,;\t]\s*[^,;\t]*(?:(lon)[^,;\t]*[,;\t][^,;\t]*lat|lat[^,;\t]*[,;\t][^,;\t]*lon)",
    re.IGNORECASE,
)
"""Titles of a table of longitudes and latitudes, in either order."""


def read_positions(path: Path, files: Collection[str]) -> tuple[dict[str, GpsPosition], list[str]]:
    """Return positions by file of the folder, and photos that it lacks; an InputError names a malformed line."""
    try:
        lines = [(number, line.strip()) for number, line in enumerate(read_text(path, MOST_BYTES).splitlines(), 1)]
        titles = TITLES.match(lines[0][1]) if lines else None
        lines = [line for line in lines[1 if titles else 0 :] if line[1] and not line[1].startswith("#")]
        system = read_system(GPS_SYSTEM) if titles else read_header(lines)[0]
        if system.is_flat:
            raise ValueError("axes of your own have no place on Earth")
        rows, missing = dict[str, list[float]](), list[str]()
        index = index_files(files)
        for number, line in lines:
            try:
                photo, values, is_there = _read_line(line, index, is_table=titles is not None)
            except ValueError as err:
                raise ValueError(f"line {number} {err}") from None
            if titles and not titles[1]:
                values[:2] = values[1::-1]
            check_position((values[0], values[1], values[2] if len(values) > 2 else 0.0), system, number)
            if not is_there:
                missing.append(photo)
            elif rows.setdefault(photo, values) != values:
                raise ValueError(f"line {number} gives '{photo}' another position than an earlier line")
        if not rows:
            raise ValueError(f"the folder has no photo '{missing[0]}'" if missing else "it holds no position")
        return dict(zip(rows, _to_gps(list(rows.values()), system), strict=True)), missing
    except OSError as err:
        raise InputError(f"cannot read the positions {path}: {err.strerror}", hint=f"name the file: {FORM}") from err
    except ValueError as err:
        raise InputError(f"{path} holds no positions of photos: {err}", hint=FORM) from err


def _read_line(line: str, index: Sequence[dict[str, list[str]]], *, is_table: bool) -> tuple[str, list[float], bool]:
    """Return the photo of a line, its numbers, and whether the photo is a file of the folder."""
    words = DIVIDERS.sub(" ", line).split()
    if len(words) < 3:
        raise ValueError("is malformed")
    tails = [(" ".join(words[:-count]), " ".join(words[-count:])) for count in range(2, min(len(words), MOST_WORDS))]
    photo, text, is_there = find_photo(tails, index)
    try:
        values = [float(word) for word in text.split()[: 3 if is_table else None]]
    except ValueError:
        raise ValueError("is malformed") from None
    if len(values) not in COUNTS:
        raise ValueError("is malformed")
    if not all(map(math.isfinite, values)):
        raise ValueError("has a value out of range")
    return photo, values, is_there


def _to_gps(rows: Sequence[Sequence[float]], system: CoordinateSystem) -> list[GpsPosition]:
    """Return positions in WGS84, with heights as they are; ValueError if they lie far outside of the system's area."""
    positions = np.array([[*row[:2], row[2] if len(row) > 2 else 0.0] for row in rows])
    here, swapped, degrees = (
        system.degrees_outside(np.median(known.geocentric_m(order), axis=0))
        for known, order in (
            (system, positions),
            (system, positions[:, [1, 0, 2]]),
            (read_system(GPS_SYSTEM), positions),
        )
    )
    if here > MISTAKES.max_degrees or here > degrees == 0.0:
        causes = {"x and y are probably swapped": swapped, "they are probably degrees, of EPSG:4326": degrees}
        cause = next((text for text, away in causes.items() if away == 0.0), "check the coordinate system")
        raise ValueError(f"the positions lie {here:.0f} degrees outside of the area of {system.name}: {cause}")
    longitudes, latitudes, heights = system.to_wgs84(positions).T.tolist()
    deviations = [[one if one > 0.0 else None for one in row[6:]] or [None, None] for row in rows]
    return [
        GpsPosition(lat, lon, up if len(row) > 2 else None, FILE, *deviation)
        for lat, lon, up, row, deviation in zip(latitudes, longitudes, heights, rows, deviations, strict=True)
    ]
