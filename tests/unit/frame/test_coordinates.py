"""Control points in the coordinate systems of the world: size and place, by formulas that do not use PROJ."""

import numpy as np
import pytest

from sfm_app.errors import InputError
from sfm_app.frame.control_points import ControlFit, fit_control_points, read_control_points
from sfm_app.frame.coordinates import LocalFrame, MapFrame, read_system
from sfm_app.frame.sighted_points import SightedPoint
from sfm_app.synthetic.cameras import axis_rotation

WGS84, GRS80, BESSEL = (6378137.0, 298.257223563), (6378137.0, 298.257222101), (6377397.155, 299.1528128)
FOOT_US, FOOT = 1200.0 / 3937.0, 0.3048
SCALE = 2.5
"""Meters per unit of the model."""


def eccentricity(ellipsoid):
    flattening = 1.0 / ellipsoid[1]
    return np.sqrt(flattening * (2.0 - flattening))


def to_geocentric(lon, lat, h, ellipsoid):
    e2 = eccentricity(ellipsoid) ** 2
    across = ellipsoid[0] / np.sqrt(1.0 - e2 * np.sin(lat) ** 2)
    level = (across + h) * np.cos(lat)
    return np.stack([level * np.cos(lon), level * np.sin(lon), (across * (1.0 - e2) + h) * np.sin(lat)], axis=-1)


def from_geocentric(points, ellipsoid):
    (x, y, z), e2 = points.T, eccentricity(ellipsoid) ** 2
    level, lat = np.hypot(x, y), np.arctan2(z, np.hypot(x, y))
    for _ in range(20):
        across = ellipsoid[0] / np.sqrt(1.0 - e2 * np.sin(lat) ** 2)
        lat = np.arctan2(z + e2 * across * np.sin(lat), level)
    return np.arctan2(y, x), lat, level / np.cos(lat) - across


def transverse_mercator(lon, lat, ellipsoid, lon0_deg, k, false_east):
    """Krueger's series to the fourth order, from the equator."""
    n, e = 1.0 / (2.0 * ellipsoid[1] - 1.0), eccentricity(ellipsoid)
    sinh = np.sinh(np.arctanh(np.sin(lat)) - e * np.arctanh(e * np.sin(lat)))
    away = lon - np.radians(lon0_deg)
    xi, eta = np.arctan2(sinh, np.cos(away)), np.arctanh(np.sin(away) / np.sqrt(1.0 + sinh**2))
    terms = (n / 2 - 2 * n**2 / 3 + 5 * n**3 / 16, 13 * n**2 / 48 - 3 * n**3 / 5, 61 * n**3 / 240)
    bent = xi + 1j * eta + sum(a * np.sin(2 * (j + 1) * (xi + 1j * eta)) for j, a in enumerate(terms))
    radius = ellipsoid[0] / (1.0 + n) * (1.0 + n**2 / 4.0 + n**4 / 64.0)
    return false_east + k * radius * bent.imag, k * radius * bent.real


def lambert(lon, lat, ellipsoid, center_deg, parallels_deg, false_origin):
    """Lambert's conformal cone with two parallels (Snyder 1987, eq. 15-1 to 15-4)."""
    e = eccentricity(ellipsoid)

    def m(phi):
        return np.cos(phi) / np.sqrt(1.0 - (e * np.sin(phi)) ** 2)

    def t(phi):
        return np.exp(e * np.arctanh(e * np.sin(phi)) - np.arctanh(np.sin(phi)))

    lon0, lat0 = np.radians(center_deg)
    first, second = np.radians(parallels_deg)
    n = np.log(m(first) / m(second)) / np.log(t(first) / t(second))
    factor = ellipsoid[0] * m(first) / (n * t(first) ** n)
    rho, rho0, theta = factor * t(lat) ** n, factor * t(lat0) ** n, n * (lon - lon0)
    return false_origin[0] + rho * np.sin(theta), false_origin[1] + rho0 - rho * np.cos(theta)


def degrees(lon, lat, h):
    return np.degrees(lon), np.degrees(lat), h


def utm(zone, ellipsoid=WGS84):
    return lambda lon, lat, h: (*transverse_mercator(lon, lat, ellipsoid, 6 * zone - 183, 0.9996, 500_000.0), h)


def long_island(lon, lat, h):
    plane = lambert(lon, lat, GRS80, (-74.0, 40 + 1 / 6), (41 + 1 / 30, 40 + 2 / 3), (300_000.0, 0.0))
    return plane[0] / FOOT_US, plane[1] / FOOT_US, h / FOOT_US


def long_island_heights(lon, lat, h):
    return (*long_island(lon, lat, h)[:2], h / FOOT)


def massachusetts(lon, lat, h):
    return (*lambert(lon, lat, GRS80, (-71.5, 41.0), (42 + 41 / 60, 41 + 43 / 60), (200_000.0, 750_000.0)), h)


def lambert_93(lon, lat, h):
    return (*lambert(lon, lat, GRS80, (3.0, 46.5), (49.0, 44.0), (700_000.0, 6_600_000.0)), h)


def gauss_kruger(lon, lat, h):
    return (*transverse_mercator(lon, lat, BESSEL, 9.0, 1.0, 3_500_000.0), h)


def web_mercator(lon, lat, h):
    return WGS84[0] * lon, WGS84[0] * np.arctanh(np.sin(lat)), h


def geocentric(lon, lat, h):
    return tuple(to_geocentric(lon, lat, h, WGS84).T)


WKT = (
    'PROJCS["mine",GEOGCS["WGS 84",DATUM["WGS_1984",SPHEROID["WGS 84",6378137,298.257223563]],PRIMEM["Greenwich",0],\n'
    'UNIT["degree",0.0174532925199433]],PROJECTION["Transverse_Mercator"],PARAMETER["latitude_of_origin",0],\n'
    'PARAMETER["central_meridian",9],PARAMETER["scale_factor",0.9996],PARAMETER["false_easting",500000],\n'
    'PARAMETER["false_northing",0],UNIT["metre",1]]'
)
SYSTEMS = {
    "EPSG:2263": ((-73.9, 40.7), GRS80, long_island),
    "EPSG:2263+8228": ((-73.9, 40.7), GRS80, long_island_heights),
    "EPSG:4326": ((16.4, 48.2), WGS84, degrees),
    "+init=epsg:4326": ((16.4, 48.2), WGS84, degrees),
    "epsg:4258": ((16.4, 48.2), GRS80, degrees),
    "EPSG:4979": ((-179.9999, 60.0), WGS84, degrees),
    "WGS84": ((16.4, -48.2), WGS84, degrees),
    "+proj=longlat +datum=WGS84 +no_defs": ((16.4, 48.2), WGS84, degrees),
    "EPSG:32632": ((6.5, 52.0), WGS84, utm(32)),
    "WGS84 UTM 32N": ((9.5, 48.0), WGS84, utm(32)),
    "+proj=utm +zone=32 +datum=WGS84": ((11.9, 48.0), WGS84, utm(32)),
    "32632": ((9.5, 48.0), WGS84, utm(32)),
    WKT: ((9.5, 48.0), WGS84, utm(32)),
    "EPSG:26986": ((-71.1, 42.4), GRS80, massachusetts),
    "EPSG:31467": ((8.2, 49.0), BESSEL, gauss_kruger),
    "EPSG:2154": ((-1.5, 47.2), GRS80, lambert_93),
    "EPSG:3857": ((10.0, 60.0), WGS84, web_mercator),
    "EPSG:4978": ((16.4, 48.2), WGS84, geocentric),
    "EPSG:5554": ((4.0, 52.0), GRS80, utm(31, GRS80)),
    "EPSG:32632+5783": ((9.5, 48.0), WGS84, utm(32)),
}
"""By the first line of the file: longitude and latitude of the scene, the ellipsoid, and the formula."""


def scene(place_deg, ellipsoid, count=8, spread_m=60.0):
    """Points (N, 3) in meters east, north and up of a place 300 m high, and their longitudes, latitudes and heights."""
    enu = np.random.default_rng(1).uniform(-1, 1, (count, 3)) * [spread_m, spread_m, spread_m / 4]
    lon, lat = np.radians(place_deg)
    axes = np.array(
        [
            [-np.sin(lon), np.cos(lon), 0.0],
            [-np.sin(lat) * np.cos(lon), -np.sin(lat) * np.sin(lon), np.cos(lat)],
            [np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)],
        ]
    )
    return enu, from_geocentric(to_geocentric(lon, lat, 300.0, ellipsoid) + enu @ axes, ellipsoid)


def write(path, header, positions, photo="a.jpg"):
    rows = [f"{x:.12g} {y:.12g} {z:.12g} 10 20 {photo} p{k}" for k, (x, y, z) in enumerate(positions)]
    path.write_text("\n".join([header, *rows]) + "\n", encoding="utf-8")
    return path


def locate(enu, deviation=1e-5):
    """The points in a model that is turned, moved and 1 / SCALE as large."""
    places = np.column_stack([enu[:, 0], enu[:, 2], -enu[:, 1]]) / SCALE
    places = places @ axis_rotation(np.array([1.0, 2.0, 2.0]) / 3.0, 15.0) + [3.0, -1.0, 8.0]
    return {f"p{k}": SightedPoint(x, np.eye(3) * deviation**2, (), ()) for k, x in enumerate(places)}


@pytest.mark.parametrize("header", SYSTEMS)
def test_size_and_place_in_a_system(tmp_path, header):
    place, ellipsoid, formula = SYSTEMS[header]
    enu, geodetic = scene(place, ellipsoid)
    positions = np.column_stack(formula(*geodetic))
    given = read_control_points(write(tmp_path / "gcp_list.txt", header, positions))
    located = locate(enu)

    fit = fit_control_points(given, located)

    assert isinstance(fit, ControlFit) and not fit.outliers
    assert fit.from_model.scale == pytest.approx(SCALE, rel=2e-5)
    assert fit.rms_m < 2e-3
    found = fit.from_model(np.array([located[f"p{k}"].place for k in range(len(enu))]))
    x, y, z = found.T
    if read_system(header).crs.is_projected:
        assert np.allclose(MapFrame(fit.place).positions(found), positions, atol=0.005)
        assert fit.place.origin == tuple(np.round(fit.place.origin))
    else:
        moved = np.column_stack([x, -z, y]) - enu
        assert np.allclose(moved, moved.mean(axis=0), atol=0.01)


def test_distances_of_web_mercator_are_not_those_on_the_ground():
    enu, geodetic = scene((10.0, 60.0), WGS84)
    positions = np.column_stack(web_mercator(*geodetic))
    ratio = np.linalg.norm(np.ptp(positions[:, :2], axis=0)) / np.linalg.norm(np.ptp(enu[:, :2], axis=0))
    assert 1.99 < ratio < 2.01


def test_noise_of_the_coordinates_is_the_residual():
    enu, geodetic = scene((9.5, 48.0), WGS84, count=40)
    positions = np.column_stack(utm(32)(*geodetic)) + 0.02 * np.random.default_rng(2).normal(size=(40, 3))
    frame = LocalFrame.around(read_system("EPSG:32632"), positions)
    differences = np.linalg.norm(np.diff(frame(positions), axis=0), axis=1) - np.linalg.norm(
        np.diff(enu, axis=0), axis=1
    )
    assert 0.02 < np.sqrt(np.mean(differences**2)) < 0.04


@pytest.mark.parametrize("header", ["EPSG:4326", "EPSG:32632", "EPSG:2263+8228", "EPSG:4978", "EPSG:3035", "local"])
def test_positions_come_back(header):
    place = {"EPSG:2263+8228": (-73.9, 40.7)}.get(header, (9.5, 48.0))
    _, geodetic = scene(place, WGS84)
    system = read_system(header)
    positions = system.positions(to_geocentric(*geodetic, WGS84))
    frame = LocalFrame.around(system, positions)
    assert np.allclose(frame.positions(frame(positions)), positions, atol=1e-3, rtol=1e-12)


@pytest.mark.parametrize(
    ("header", "says"),
    [
        ("hello world", "line 1: 'hello world' is no coordinate system"),
        ("EPSG:326322", "line 1: 'EPSG:326322' is no coordinate system"),
        ("EPGS:32632", "is no coordinate system"),
        ("WGS84 UTM 75N", "is no coordinate system"),
        ("+proj=utm +zone=99 +datum=WGS84", "is no coordinate system"),
        ("+proj=lcc +units=us-ft", "is no coordinate system"),
        ("lambert", "is no coordinate system"),
        (WKT.replace("Transverse", "Transverse of mine"), "is no coordinate system"),
        (5000 * '{"a":', "is no coordinate system"),
        ("EPSG:5703", "'NAVD88 height' has no horizontal coordinates"),
        ("# nothing but a comment", "line 2 is a mark, where the coordinate system must stand"),
        ("500001 4649001 320 11 21 a.jpg p", "line 1 is a mark, where the coordinate system must stand"),
    ],
)
def test_an_unknown_or_absent_system_is_refused_with_its_line(tmp_path, header, says):
    with pytest.raises(InputError, match="holds no ground control points") as caught:
        read_control_points(write(tmp_path / "gcp_list.txt", header, [(500000.0, 4649000.0, 320.0)]))
    assert says in str(caught.value) and "EPSG:32632" in caught.value.hint


@pytest.mark.parametrize(
    ("header", "position", "advice"),
    [
        ("EPSG:4326", (151.0, -33.9, 5.0), None),
        ("EPSG:4326", (-33.9, 151.0, 5.0), "swap them"),
        ("EPSG:4978", (16.4, 48.2, 300.0), ""),
        ("EPSG:32632", (1e9, 1e9, 0.0), ""),
        ("EPSG:4978", (1e200, 1e200, 0.0), ""),
        ("local", (1e9, 0.0, 0.0), ""),
        ("EPSG:4326", (16.4, 48.2, 1e6), ""),
    ],
)
def test_positions_off_the_earth_are_refused_with_their_line(tmp_path, header, position, advice):
    path = write(tmp_path / "gcp_list.txt", header, [position])
    if advice is None:
        assert read_control_points(path)
    else:
        with pytest.raises(InputError, match=rf"line 2 has a position out of range.*{advice}"):
            read_control_points(path)


def test_the_network_stays_closed():
    from pyproj.network import is_network_enabled

    read_system("EPSG:32632+5783")
    assert not is_network_enabled()
