"""Lines of equal height, as a GeoPackage: an SQLite file by the standard of the Open Geospatial Consortium."""

import sqlite3
import struct
from collections.abc import Iterable, Iterator
from contextlib import closing
from math import ceil, floor
from pathlib import Path

import numpy as np

from sfm_app.errors import InputError
from sfm_app.files import replace_atomically
from sfm_app.maps.drawing import Grid, Tile, assemble
from sfm_app.maps.sheets import floor_to_usual
from sfm_app.types.arrays import FloatArray

Contour = tuple[float, FloatArray]
"""A height, and the points (N, 2) of a line."""

LEVELS, MOST_LEVELS = 20, 10_000
"""Least number of heights by default, and the most. By hand: readable on a screen, and a typing error."""
LEAST_M = 1e-9
"""Reach of level ground, whose lines need some step. By definition: rounding."""
PERCENT = (1.0, 99.0)
"""Heights between which these levels lie, in percent of all pixels. Chosen by hand: borders have outliers."""
MOST_PIXELS = 16e6
"""Pixels that contours are drawn from. Chosen by hand: 200 MB; lines need no more."""
COARSE = 4.0
"""Their side in texels. Chosen by hand: finer ones follow the noise of the surface."""
UNDEFINED, OWN = -1, 100_000
"""Numbers of an unknown system, by the standard, and of one without a number."""
WGS84 = 4326
"""Number of a system that each file has to name, by the standard."""
TABLES = """
PRAGMA application_id = 0x47504B47;
PRAGMA user_version = 10300;
CREATE TABLE gpkg_spatial_ref_sys (srs_name TEXT NOT NULL, srs_id INTEGER PRIMARY KEY, organization TEXT NOT NULL,
    organization_coordsys_id INTEGER NOT NULL, definition TEXT NOT NULL, description TEXT);
CREATE TABLE gpkg_contents (table_name TEXT NOT NULL PRIMARY KEY, data_type TEXT NOT NULL, identifier TEXT UNIQUE,
    description TEXT DEFAULT '', last_change DATETIME NOT NULL, min_x DOUBLE, min_y DOUBLE, max_x DOUBLE, max_y DOUBLE,
    srs_id INTEGER);
CREATE TABLE gpkg_geometry_columns (table_name TEXT NOT NULL, column_name TEXT NOT NULL,
    geometry_type_name TEXT NOT NULL, srs_id INTEGER NOT NULL, z TINYINT NOT NULL, m TINYINT NOT NULL,
    PRIMARY KEY (table_name, column_name));
CREATE TABLE contours (fid INTEGER PRIMARY KEY AUTOINCREMENT NOT NULL, geom LINESTRING, height DOUBLE);
"""
NO_DATE = "1970-01-01T00:00:00.000Z"
"""The same lines give the same bytes."""


def contour_pixel(corners: FloatArray, texel: float) -> float:
    """Return the side of the pixels that contours of triangles (T, 3, 5) are drawn from."""
    width, height = np.ptp(corners[:, :, :2].reshape(-1, 2), axis=0)
    return max(COARSE * texel, float(np.sqrt(width * height / MOST_PIXELS)))


def find_contours(tiles: Iterable[Tile], grid: Grid, interval: float = 0.0) -> Iterator[Contour]:
    """Yield the lines at multiples of an interval, of a round one if it is 0; InputError if these are too many."""
    import contourpy

    heights = assemble(tiles, grid).astype(np.float64)
    known = heights[np.isfinite(heights)]
    if not len(known):
        return
    step = interval or floor_to_usual(max(float(np.ptp(np.percentile(known, PERCENT))), LEAST_M) / LEVELS)
    first, last = ceil(known.min() / step), floor(known.max() / step)
    if last - first > MOST_LEVELS:
        raise InputError(f"contours would have {last - first} heights", hint="name a larger --interval")
    x = grid.left + (np.arange(grid.width) + 0.5) * grid.resolution
    y = grid.top - (np.arange(grid.height) + 0.5) * grid.resolution
    found = contourpy.contour_generator(x, y, np.ma.masked_invalid(heights), line_type=contourpy.LineType.Separate)
    for level in range(first, last + 1):
        for line in found.lines(level * step):
            yield level * step, np.asarray(line, np.float64)


def write_geopackage(contours: Iterable[Contour], wkt: str, target: Path) -> None:
    """Write lines as the layer `contours` of a GeoPackage; OSError if it cannot be written."""
    systems = _systems(wkt)
    number = systems[-1][1] if wkt else UNDEFINED
    low, high = np.full(2, np.inf), np.full(2, -np.inf)
    with replace_atomically(target) as draft:
        try:
            with closing(sqlite3.connect(draft)) as base, base:
                base.executescript(TABLES)
                base.executemany("INSERT INTO gpkg_spatial_ref_sys VALUES (?, ?, ?, ?, ?, NULL)", systems)
                for height, line in contours:
                    low, high = np.minimum(low, line.min(axis=0)), np.maximum(high, line.max(axis=0))
                    row = (_geometry(line, number), height)
                    base.execute("INSERT INTO contours (geom, height) VALUES (?, ?)", row)
                box = [*low.tolist(), *high.tolist()] if np.isfinite(low).all() else [None] * 4
                about = ("contours", "features", "contours", "", NO_DATE, *box, number)
                base.execute("INSERT INTO gpkg_contents VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?, ?)", about)
                column = ("contours", "geom", "LINESTRING", number, 0, 0)
                base.execute("INSERT INTO gpkg_geometry_columns VALUES (?, ?, ?, ?, ?, ?)", column)
        except sqlite3.Error as err:
            raise OSError(str(err)) from err


def _systems(wkt: str) -> list[tuple[str, int, str, int, str]]:
    """Return name, number, organization, its number and WKT of all systems of a file, last its own if there is one."""
    import pyproj

    systems = [
        ("Undefined Cartesian", UNDEFINED, "NONE", UNDEFINED, "undefined"),
        ("Undefined geographic", 0, "NONE", 0, "undefined"),
        ("WGS 84", WGS84, "EPSG", WGS84, pyproj.CRS(WGS84).to_wkt("WKT1_GDAL")),
    ]
    if not wkt:
        return systems
    crs = pyproj.CRS.from_wkt(wkt)
    code = crs.to_epsg()
    return [*systems, (crs.name, code or OWN, "EPSG" if code else "NONE", code or OWN, wkt)]


def _geometry(line: FloatArray, system: int) -> bytes:
    """Return a line (N, 2) as a geometry of a GeoPackage: little endian, with its envelope."""
    (x0, y0), (x1, y1) = line.min(axis=0), line.max(axis=0)
    head = struct.pack("<2sBBi4d", b"GP", 0, 0b011, system, x0, x1, y0, y1)
    return head + struct.pack("<BII", 1, 2, len(line)) + line.astype("<f8").tobytes()
