"""Where a raster lies: on the map, in a plane on the ground, on a wall, or in a section."""

from dataclasses import dataclass

import numpy as np

from sfm_app.errors import ConfigError, ReconstructionError
from sfm_app.frame.coordinates import MapFrame
from sfm_app.frame.scale import MetricFrame
from sfm_app.geometry.poses import normalize, perpendicular_component
from sfm_app.types import Surface
from sfm_app.types.arrays import FloatArray
from sfm_app.wording import parse_point

FACADE = "facade"
"""Word for the dominant vertical plane."""
LOCAL = 'LOCAL_CS["sfm_app {name}",UNIT["metre",1]]'
"""System of a plane in meters without a place on the map, in GDAL's well-known text."""
UP = np.array([0.0, 1.0, 0.0])
NORTH = np.array([0.0, 0.0, -1.0])
"""Up in the picture of a plane on the ground, in the frame of exported files."""


class OPTIONS:
    """Constants of planes."""

    flat_deg: float = 10.0
    """Largest slope of a plane whose picture has `NORTH` at its top. Chosen by hand: people pick floors so well."""
    upright_deg: float = 20.0
    """Largest angle of the faces of a wall to the vertical. Chosen by hand: reliefs and sills lie beyond."""
    bin_deg: float = 1.0
    """Step of the directions of walls. Chosen by hand: a tenth of their scatter."""
    spread_deg: float = 10.0
    """Standard deviation with which directions count together. Chosen by hand: walls of masonry scatter as much."""
    turn_deg: float = 30.0
    """Largest angle of faces to the direction of their wall. Chosen by hand."""
    depth: float = 0.02
    """Half the depth of a wall as a share of the longest side of the surface. Chosen by hand: 40 cm of a 20 m house."""


@dataclass(frozen=True, slots=True, eq=False)
class Projection:
    """The vertices of a surface as a raster shows them."""

    points: FloatArray
    """(V, 3) x to the right and y up in the picture, and height towards the viewer, in units."""
    wkt: str
    """Coordinate system of x and y; empty if the size is unknown."""
    unit_m: float
    """Meters per unit of x and y; 0 if the size is unknown."""
    height_m: float
    """The same of heights."""
    title: str
    """Where it lies, for people."""
    cut: bool = False
    """Whether only heights below 0 are shown."""


def project(surface: Surface, frame: MetricFrame, plane: str = "") -> Projection:
    """Return a surface of exported files on the map, or on a plane as in `read_plane`.

    Heights on the map go up also where those of the system go down.
    """
    if plane:
        return _on_plane(surface, frame, plane)
    if frame.place is not None:
        here = MapFrame(frame.place)
        points = here.positions(surface.vertices) * [1.0, 1.0, np.sign(here.z_m)]
        wkt, title = (here.wkt, here.title) if here.wkt else (LOCAL.format(name="axes"), "your own axes")
        return Projection(points, wkt, here.unit_m, abs(here.z_m), title)
    axes = np.stack([np.cross(NORTH, UP), NORTH, UP])
    return _in_axes(surface.vertices @ axes.T, frame, "ground plane")


def _in_axes(points: FloatArray, frame: MetricFrame, name: str, cut: bool = False) -> Projection:
    unit = float(frame.is_metric)
    return Projection(points, LOCAL.format(name=name) if unit else "", unit, unit, name, cut)


# Walls and sections.


def read_plane(text: str) -> list[FloatArray]:
    """Return two or three points (3,) of a text, none for `FACADE`; ConfigError for others."""
    if text == FACADE:
        return []
    try:
        points = [np.array(parse_point(word)) for word in text.split()]
    except ValueError as err:
        raise _bad_plane(str(err)) from None
    if len(points) not in (2, 3):
        raise _bad_plane(f"--plane has {len(points)} points")
    return points


def _bad_plane(reason: str) -> ConfigError:
    hint = f"--plane {FACADE}, three points of a plane, or the two ends of a section, such as 0,0,0 1,0,0"
    return ConfigError(reason, hint=hint)


def _on_plane(surface: Surface, frame: MetricFrame, plane: str) -> Projection:
    points = read_plane(plane)
    if not points:
        normal, origin = find_facade(surface)
    elif len(points) == 2:
        origin = points[0]
        normal = normalize(np.cross(points[1] - origin, UP))
    else:
        origin = points[0]
        normal = normalize(np.cross(points[1] - origin, points[2] - origin))
    if points and not normal.any():
        raise _bad_plane("the points lie on one " + ("vertical line" if len(points) == 2 else "line"))
    up = NORTH if abs(normal @ UP) > np.cos(np.radians(OPTIONS.flat_deg)) else UP
    up = normalize(perpendicular_component(up, normal))
    axes = np.stack([np.cross(up, normal), up, normal])
    moved = surface.vertices @ axes.T - [0.0, 0.0, normal @ origin]
    name = "main wall" if not points else "section" if len(points) == 2 else "given plane"
    return _in_axes(moved, frame, name, cut=len(points) == 2)


def find_facade(surface: Surface) -> tuple[FloatArray, FloatArray]:
    """Return the outward normal (3,) and a point (3,) of the vertical plane with most of the surface.

    First the direction that most area of upright faces has, then the depth with most area of that direction, and a
    plane by total least squares. ReconstructionError without upright faces.
    """
    corners = surface.vertices[surface.faces]
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.linalg.norm(across, axis=1)
    upright = (area > 0.0) & (np.abs(across[:, 1]) < np.sin(np.radians(OPTIONS.upright_deg)) * area)
    if not upright.any():
        raise ReconstructionError("the surface has no upright faces", hint="name three points of a plane with --plane")
    across, area = across[upright], area[upright]
    bearing = np.degrees(np.arctan2(across[:, 0], across[:, 2]))
    best = _densest_bearing(bearing, area)
    own = np.abs((bearing - best + 180.0) % 360.0 - 180.0) < OPTIONS.turn_deg
    flat, weight = corners[upright][own][:, :, [0, 2]].reshape(-1, 2), np.repeat(area[own], 3)
    out = normal = np.array([np.sin(np.radians(best)), np.cos(np.radians(best))])
    reach = OPTIONS.depth * float(np.ptp(surface.vertices, axis=0).max())
    depth = _densest_depth(flat @ normal, weight, reach)
    for _ in range(5):  # until the faces of the wall no longer change, which three rounds do
        near = np.abs(flat @ normal - depth) <= reach
        center = np.average(flat[near], axis=0, weights=weight[near])
        across_wall = np.linalg.eigh(np.cov(flat[near].T, aweights=weight[near]))[1][:, 0]
        normal = across_wall if across_wall @ out > 0.0 else -across_wall
        depth = float(center @ normal)
    return np.array([normal[0], 0.0, normal[1]]), np.array([center[0], 0.0, center[1]])


def _densest_bearing(bearing: FloatArray, area: FloatArray) -> float:
    """Return the direction in degrees with most area around it."""
    count = round(360.0 / OPTIONS.bin_deg)
    amounts = np.bincount((bearing // OPTIONS.bin_deg).astype(np.int64) % count, area, count)
    away = np.minimum(np.arange(count), count - np.arange(count)) * OPTIONS.bin_deg / OPTIONS.spread_deg
    smooth = np.fft.irfft(np.fft.rfft(amounts) * np.fft.rfft(np.exp(-0.5 * away**2)), count)
    return (float(np.argmax(smooth)) + 0.5) * OPTIONS.bin_deg


def _densest_depth(depths: FloatArray, weight: FloatArray, reach: float) -> float:
    """Return the depth with most weight within `reach`, that of one of `depths`."""
    order = np.argsort(depths)
    total = np.concatenate([[0.0], np.cumsum(weight[order])])
    low, high = (np.searchsorted(depths[order], depths[order] + side, "right") for side in (-reach, reach))
    return float(depths[order[np.argmax(total[high] - total[low])]])
