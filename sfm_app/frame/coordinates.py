"""Coordinate systems of the Earth, by PROJ, and local frames in meters."""

import re
from functools import lru_cache
from typing import Any

import numpy as np

from sfm_app.errors import NumericalError
from sfm_app.types import MapPlace
from sfm_app.types.arrays import FloatArray

GPS_SYSTEM = "EPSG:4979"
"""WGS84: longitude and latitude in degrees, height in meters."""
OPENDRONEMAP_UTM = re.compile(r"WGS ?84 */? *UTM *(?:zone *)?(\d{1,2}) *([NS])", re.IGNORECASE)
LOCAL = 'ENGCRS["local",EDATUM["local"],CS[Cartesian,3],AXIS["x",east],AXIS["y",north],AXIS["z",up],LENGTHUNIT["m",1]]'
"""System of the word `local`: meters along axes of the user's own."""
EARTH_M = (6.3e6, 6.45e6)
"""Distances from the center of the Earth between which all ground lies, in meters. The poles are at 6.357e6."""
FLAT_M = 1e8
"""Largest coordinate along the user's own axes, in meters. Chosen by hand."""


class CoordinateSystem:
    """A system of positions (N, 3) in its own units: x east or longitude, y north or latitude, z up.

    Heights count as above the ellipsoid, since grids of the geoid may be absent: lengths change by 1e-5. They have
    the system's unit of height, else its unit of length, else meters.
    """

    def __init__(self, text: str, crs: Any) -> None:
        """`text` is the name for people, `crs` that of pyproj."""
        from pyproj import Transformer

        self.given = crs
        crs = _unbound(crs)
        parts = [_unbound(part) for part in crs.sub_crs_list] if crs.is_compound else [crs]
        self.crs, axes = parts[0], parts[0].axis_info
        self.is_flat: bool = self.crs.is_engineering
        if not (self.is_flat or self.crs.is_geographic or self.crs.is_projected or self.crs.is_geocentric):
            raise ValueError(f"'{crs.name}' has no horizontal coordinates")
        self.name: str = crs.name if "[" in text or "{" in text else text
        self.title: str = text if crs.name == "unknown" else crs.name
        heights = parts[1].axis_info[0] if len(parts) > 1 else axes[2] if len(axes) > 2 else None
        self.has_heights, self.unit = heights is not None, axes[0].unit_conversion_factor
        """Meters per unit of x; radians in a geographic system."""
        self.z_m = 1.0 if self.crs.is_geographic else self.unit
        """Meters per unit of z; negative for depths."""
        if heights is not None:
            self.z_m = heights.unit_conversion_factor * (-1.0 if heights.direction == "down" else 1.0)
        self._linear = (self.unit, self.unit, self.z_m) if self.is_flat or self.crs.is_geocentric else None
        if not self.is_flat:
            datum, shape = self.crs.geodetic_crs, self.crs.ellipsoid
            self.ellipsoid = f"+a={shape.semi_major_metre!r} +b={shape.semi_minor_metre!r}"
            self._cart = Transformer.from_pipeline(f"+proj=cart {self.ellipsoid}")
            self._to_datum = Transformer.from_crs(self.crs, datum, always_xy=True)
            self._angle = datum.axis_info[0].unit_conversion_factor
            self._meridian = datum.prime_meridian.longitude * datum.prime_meridian.unit_conversion_factor

    def geocentric_m(self, positions: FloatArray) -> FloatArray:
        """Return points (N, 3) from the center of the ellipsoid; NaN far from the ground. A flat system has its own."""
        if self._linear:
            points = np.asarray(positions * self._linear)
        else:
            x, y, z = positions.T
            longitude, latitude = (self._angle * value for value in self._to_datum.transform(x, y))
            latitude = np.where(np.abs(latitude) <= np.pi / 2, latitude, np.nan)
            points = np.column_stack(
                self._cart.transform(longitude + self._meridian, latitude, z * self.z_m, radians=True)
            )
        low, high = (0.0, FLAT_M) if self.is_flat else EARTH_M
        with np.errstate(over="ignore"):
            distances = np.linalg.norm(points, axis=1)
        on_ground = (distances >= low) & (distances <= high)
        return np.where(on_ground[:, None], points, np.nan)

    def positions(self, points: FloatArray) -> FloatArray:
        """Return points (N, 3) from `geocentric_m` as positions."""
        if self._linear:
            return np.asarray(points / self._linear)
        longitude, latitude, height = self.geodetic(points).T
        angles = (longitude - self._meridian) / self._angle, latitude / self._angle
        return np.column_stack([*self._to_datum.transform(*angles, direction="INVERSE"), height / self.z_m])

    def geodetic(self, points: FloatArray) -> FloatArray:
        """Return longitude from Greenwich, latitude, both in radians, and height in meters of geocentric points."""
        x, y, z = points.T
        return np.column_stack(self._cart.transform(x, y, z, radians=True, direction="INVERSE"))

    def to_wgs84(self, positions: FloatArray) -> FloatArray:
        """Return longitude, latitude in degrees and height (N, 3); heights change their unit only."""
        from pyproj import Transformer

        if self.crs.is_geocentric:
            return np.asarray(self.geodetic(self.geocentric_m(positions)) * [*2 * [180.0 / np.pi], 1.0])
        flat = self.crs if self.given.is_compound else self.given.to_2d()
        change = Transformer.from_crs(flat, "EPSG:4326", always_xy=True)
        return np.column_stack([*change.transform(*positions[:, :2].T), positions[:, 2] * self.z_m])

    def degrees_outside(self, point: FloatArray) -> float:
        """Return how far a geocentric point (3,) lies outside of the area for which the system is made; 0 inside."""
        area = self.crs.area_of_use
        if area is None or self.is_flat:
            return 0.0
        longitude, latitude, _ = np.degrees(self.geodetic(point[None])[0])
        width = (area.east - area.west) % 360.0 or 360.0
        beyond = (longitude - area.west) % 360.0 - width
        return float(max(min(beyond, 360.0 - width - beyond), area.south - latitude, latitude - area.north, 0.0))


class LocalFrame:
    """A Cartesian frame in meters: x east, y north and z up of an origin, on the tangent plane of the ellipsoid.

    Lengths are those on the ground, also where a projection distorts them. In a conformal projection, x follows its
    grid instead of the east.
    """

    def __init__(self, system: CoordinateSystem, origin: FloatArray) -> None:
        """`origin` is a position (3,); a NumericalError says that it is not on Earth."""
        from pyproj import Transformer

        self.system, self.origin, self.center = system, origin, system.geocentric_m(origin[None])[0]
        if not np.isfinite(self.center).all():
            raise NumericalError("the coordinates are not on Earth")
        self._turn = np.eye(3)
        if not system.is_flat:
            X, Y, Z = self.center.tolist()
            pipeline = f"+proj=topocentric {system.ellipsoid} +X_0={X!r} +Y_0={Y!r} +Z_0={Z!r}"
            self._topocentric = Transformer.from_pipeline(pipeline)
        if system.crs.is_projected:
            self._follow_grid()

    @classmethod
    def around(cls, system: CoordinateSystem, positions: FloatArray) -> "LocalFrame":
        """Return the frame at the median of positions (N, 3), rounded to whole units of a grid."""
        middle = system.positions(np.median(system.geocentric_m(positions), axis=0)[None])[0]
        return cls(system, np.round(middle) if system.crs.is_projected or system.is_flat else middle)

    def __call__(self, positions: FloatArray) -> FloatArray:
        """Return positions (N, 3) of the system in the frame."""
        points = self.system.geocentric_m(positions)
        if self.system.is_flat:
            return np.asarray(points - self.center)
        return np.column_stack(self._topocentric.transform(*points.T)) @ self._turn.T

    def positions(self, points: FloatArray) -> FloatArray:
        """Return points (N, 3) of the frame as positions in the system."""
        return self.system.positions(self.geocentric_m(points))

    def geocentric_m(self, points: FloatArray) -> FloatArray:
        """Return points (N, 3) of the frame as those of the system's `geocentric_m`."""
        if self.system.is_flat:
            return np.asarray(points + self.center)
        x, y, z = (points @ self._turn).T
        return np.column_stack(self._topocentric.transform(x, y, z, direction="INVERSE"))

    def _follow_grid(self) -> None:
        """Turn x to the grid if that is conformal here to a percent, as Web Mercator is."""
        step = 10.0  # in the grid's units: the Earth is flat over it to 1e-6
        (xx, xy, _), (yx, yy, _) = self(self.origin + step * np.eye(3)[:2]) / step
        along = complex(xx + yy, xy - yx) / 2.0
        if abs(complex(xx, xy) - along) < 0.01 * abs(along):
            c = along.conjugate() / abs(along)
            self._turn = np.array([[c.real, -c.imag, 0.0], [c.imag, c.real, 0.0], [0.0, 0.0, 1.0]])


class MapFrame:
    """A frame in meters with y up on a map: the projected system of its place, else the zone of UTM on its datum."""

    def __init__(self, place: MapPlace) -> None:
        self._local = LocalFrame(read_system(place.system), np.array(place.origin))
        cosine, sine = np.cos(np.radians(place.heading_deg)), np.sin(np.radians(place.heading_deg))
        self._turn = np.array([[cosine, -sine, 0.0], [0.0, 0.0, 1.0], [-sine, -cosine, 0.0]])
        known = self._local.system
        self._system = known if known.crs.is_projected or known.is_flat else _utm(known, self._local.center)
        self.wkt = "" if known.is_flat else _well_known_text(self._system.given)
        """Its system; empty for axes of the user's own."""
        self.title, self.unit_m, self.z_m = self._system.title, self._system.unit, self._system.z_m
        """Name for people; meters per unit of x and y, and of z; the latter is negative for depths."""

    def positions(self, points: FloatArray) -> FloatArray:
        """Return points (N, 3) of the frame on the map: x east, y north, z up, in units of the system."""
        return self._system.positions(self._local.geocentric_m(points @ self._turn))

    def to_dict(self) -> dict[str, Any]:
        """Return the system, the offset, and the linear map of points near (0, 0, 0) as plain values.

        The Earth bends away from it, by 1 mm at 110 m.
        """
        offset = self.positions(np.zeros((1, 3)))[0]
        linear = (self.positions(np.eye(3)) - self.positions(-np.eye(3))).T / 2.0
        matrix = np.vstack([np.column_stack([linear, offset]), [0.0, 0.0, 0.0, 1.0]])
        system = {"system": self._system.name, "wkt": self.wkt}
        return system | {"offset": offset.tolist(), "transform": matrix.tolist()}


def _well_known_text(crs: Any) -> str:
    """Return a system of pyproj in the version of the LAS standard, or in a newer one that can express it."""
    from pyproj.exceptions import CRSError

    try:
        return str(crs.to_wkt("WKT1_GDAL"))
    except CRSError:
        return str(crs.to_wkt())


def _utm(system: CoordinateSystem, center: FloatArray) -> CoordinateSystem:
    """Return the zone of UTM of a geocentric point (3,), on the datum of a system, which avoids a shift."""
    from pyproj.crs import GeographicCRS, ProjectedCRS
    from pyproj.crs.coordinate_operation import UTMConversion

    longitude, latitude, _ = np.degrees(system.geodetic(center[None])[0])
    zone, side = int((longitude + 180.0) // 6.0) % 60 + 1, "N" if latitude >= 0.0 else "S"
    if system.crs.datum.name.startswith("World Geodetic System 1984"):
        return read_system(f"EPSG:{(32600 if side == 'N' else 32700) + zone}")
    base = GeographicCRS(name=system.crs.geodetic_crs.name, datum=system.crs.datum)
    name = f"{base.name} / UTM zone {zone}{side}"
    crs = ProjectedCRS(UTMConversion(zone, hemisphere=side), name=name, geodetic_crs=base)
    return CoordinateSystem(crs.to_wkt(), crs)


@lru_cache(maxsize=64)
def read_system(text: str) -> CoordinateSystem:
    """Read a code, a PROJ string, WKT, a name or `local`; a ValueError says that PROJ knows no such system."""
    import pyproj  # takes a third of a second to load
    from pyproj.network import set_network_enabled

    set_network_enabled(False)
    code = re.sub(r"^\+init=(\S+).*", r"\1", LOCAL if text.casefold() == "local" else text)
    code = OPENDRONEMAP_UTM.sub(r"WGS 84 / UTM zone \1\2", code)
    unknown = f"'{text[:60]}' is no coordinate system that PROJ knows"
    try:
        crs = pyproj.CRS.from_user_input(code)
        # PROJ also takes names that merely resemble its own
        if not re.search(r"[:=\[{]|^\d+$", code) and _letters(crs.name) != _letters(code):
            raise ValueError(f"{unknown}; the nearest name is '{crs.name}'")
        return CoordinateSystem(text, crs)
    except (pyproj.exceptions.ProjError, RecursionError):  # JSON may be nested
        raise ValueError(unknown) from None


def _unbound(crs: Any) -> Any:
    """Return a system without its transformation to another datum, which does not change lengths."""
    return _unbound(crs.source_crs) if crs.is_bound else crs


def _letters(name: str) -> str:
    return re.sub(r"[\W_]", "", name).casefold()
