"""Ground control points that the user gave."""

from collections.abc import Mapping
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class ControlPoint:
    """A point whose place is known, and where photos show it."""

    name: str
    position: tuple[float, float, float]
    """East, north and up in the coordinate system of the file, in meters; longitude, latitude and meters if that is
    geographic."""
    marks: Mapping[str, tuple[float, float]]
    """By photo: x and y in pixels of the upright photo at its full size; pixel centers at +0.5."""


@dataclass(frozen=True, slots=True)
class ControlPoints:
    """Contents of a file of ground control points; falsy where none was given."""

    points: tuple[ControlPoint, ...] = ()
    crs: str = ""
    """Coordinate system, as the file says it."""
    geographic: bool = False
    """Whether positions are longitude and latitude in degrees (WGS84)."""
    source: str = ""
    """Path of the file, for people."""
    digest: str = ""
    """Hash of what was read; empty where nothing was given."""

    def __bool__(self) -> bool:
        return bool(self.points)
