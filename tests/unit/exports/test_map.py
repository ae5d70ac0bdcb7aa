"""Exports on the map, against formulas that do not use PROJ."""

import json

import laspy
import numpy as np
import pyproj
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import sfm_app
from sfm_app.frame.coordinates import MapFrame
from sfm_app.frame.scale import MetricFrame
from sfm_app.geometry.poses import Similarity
from sfm_app.numerical import json_text
from sfm_app.pipeline import SCALE
from sfm_app.runtime.workspace import StageRecord, Workspace
from sfm_app.synthetic.cameras import axis_rotation
from sfm_app.types import MapPlace
from tests.unit.frame.test_coordinates import (
    BESSEL,
    SYSTEMS,
    WGS84,
    from_geocentric,
    to_geocentric,
    transverse_mercator,
)

LON, LAT, HEIGHT = 9.35, 46.5, 1230.0


def enu_axes(lon, lat):
    """(3, 3) east, north and up as rows, in the axes of geocentric coordinates."""
    east = [-np.sin(lon), np.cos(lon), 0.0]
    north = [-np.sin(lat) * np.cos(lon), -np.sin(lat) * np.sin(lon), np.cos(lat)]
    return np.array([east, north, [np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)]])


def on_earth(points, place, ellipsoid, heading_deg):
    """Longitude, latitude and height of points (N, 3) with y up in a frame at a place."""
    turned = points @ axis_rotation(np.array([0.0, 1.0, 0.0]), heading_deg).T
    enu = np.column_stack([turned[:, 0], -turned[:, 2], turned[:, 1]])
    lon, lat = np.radians(place[:2])
    return from_geocentric(to_geocentric(lon, lat, place[2], ellipsoid) + enu @ enu_axes(lon, lat), ellipsoid)


def utm(lon, lat, height, ellipsoid=WGS84, south=False, zone=32):
    east, north = transverse_mercator(lon, lat, ellipsoid, 6 * zone - 183, 0.9996, 500_000.0)
    return np.column_stack([east, north + 10_000_000.0 * south, height])


def store(place, frame):
    """Change the frame of a finished run."""
    place.scale.write_text(json_text(frame.to_dict()), encoding="utf-8")
    place.manifest.finish("scale", StageRecord("", 0.0, digest=SCALE.digest(place)), {})


@pytest.fixture
def placed(make_run):
    """Makes a finished run in a frame of meters at a place; returns its folder and the points of its cloud there."""

    def make(place, scale=3.0):
        run = make_run(until="mesh")
        frame = Similarity(scale, axis_rotation(np.array([1.0, 0.0, 0.0]), 25.0), np.array([1.0, -2.0, 5.0]))
        stored = MetricFrame(frame, 0.01, "GPS", place=place)
        store(run.place, stored)
        points = frame(np.stack([run.cloud[key] for key in ("x", "y", "z")], axis=1).astype(np.float64))
        return run.out, points

    return make


def check(out, points, expected, code):
    """Compare the cloud on the map, and the transform in the record of the cloud that stays near zero."""
    for name in ("laz", "las"):
        cloud = laspy.read(sfm_app.export_scene(out, name))
        np.testing.assert_allclose(cloud.xyz, expected, rtol=0, atol=0.001)
        if code:
            assert cloud.header.parse_crs().to_epsg() == code
    near = laspy.read(out / "cloud.las").header
    assert np.abs(near.offsets - expected.min(axis=0)).max() < 0.001
    record = json.loads((out / "export.json").read_text())["map"]
    mapped = np.column_stack([points, np.ones(len(points))]) @ np.array(record["transform"]).T
    np.testing.assert_allclose(mapped[:, :3], expected, rtol=0, atol=0.001)
    assert [row[3] for row in record["transform"][:3]] == record["offset"]
    return record


@pytest.mark.parametrize(
    ("lon", "lat", "heading_deg", "code"),
    [(LON, LAT, 0.0, 32632), (LON, LAT, 137.0, 32632), (-71.2, -33.4, 300.0, 32719), (179.99, 0.001, 12.0, 32660)],
)
def test_gps_puts_the_cloud_into_the_zone_of_utm(placed, lon, lat, heading_deg, code):
    out, points = placed(MapPlace("EPSG:4979", (lon, lat, HEIGHT), heading_deg))
    found = on_earth(points, (lon, lat, HEIGHT), WGS84, -heading_deg)
    record = check(out, points, utm(*found, south=lat < 0, zone=code % 100), code)
    assert record["system"] == f"EPSG:{code}"


@settings(max_examples=60)
@given(
    st.floats(-179.9, 179.9), st.floats(-79.0, 79.0), st.floats(-100.0, 5000.0), st.floats(0.0, 360.0),
    st.lists(st.tuples(*[st.floats(-300.0, 300.0)] * 3), min_size=1, max_size=4),
)  # fmt: skip
def test_any_place_agrees_with_formulas(lon, lat, height, heading_deg, points):
    place = MapPlace("EPSG:4979", (lon, lat, height), heading_deg)
    points = np.array(points)
    found = on_earth(points, place.origin, WGS84, -heading_deg)
    zone = int((lon + 180.0) // 6.0) + 1
    expected = utm(*found, south=lat < 0.0, zone=zone)
    here = MapFrame(place)
    assert np.abs(here.positions(points) - expected).max() < 0.001
    known = here.to_dict()
    linear = np.column_stack([points, np.ones(len(points))]) @ np.array(known["transform"]).T
    reach = np.linalg.norm(points, axis=1).max()
    assert np.abs(linear[:, :3] - expected).max() < 0.001 + reach**2 / 2e6
    assert pyproj.CRS(known["wkt"]).utm_zone == f"{zone}{'S' if lat < 0 else 'N'}"


def test_geographic_control_points_keep_their_datum(placed):
    """A shift between datums would move the cloud by a hundred meters."""
    out, points = placed(MapPlace("EPSG:4314", (LON, LAT, HEIGHT)))
    found = on_earth(points, (LON, LAT, HEIGHT), BESSEL, 0.0)
    check(out, points, utm(*found, BESSEL), None)
    crs = laspy.read(out / "cloud.laz").header.parse_crs()
    assert crs.name == "DHDN / UTM zone 32N" and crs.ellipsoid.name == "Bessel 1841"


def grid_turn_deg(project, lon, lat):
    """Clockwise turn of the grid's north from north."""
    here, there = (np.array(project(lon, lat + step, 0.0))[:2] for step in (0.0, 1e-6))
    return float(np.degrees(np.arctan2(here[0] - there[0], there[1] - here[1])))


@pytest.mark.parametrize("code", ["EPSG:2263", "EPSG:2263+8228", "EPSG:31467", "EPSG:2154", "EPSG:5554"])
def test_control_points_keep_their_projected_system(placed, code):
    (lon_deg, lat_deg), ellipsoid, project = SYSTEMS[code]
    lon, lat = np.radians([lon_deg, lat_deg])
    out, points = placed(MapPlace(code, tuple(map(float, project(lon, lat, 25.0)))))
    found = on_earth(points, (lon_deg, lat_deg, 25.0), ellipsoid, -grid_turn_deg(project, lon, lat))
    record = check(out, points, np.column_stack(project(*found)), None)
    assert record["system"] == code
    crs = laspy.read(out / "cloud.laz").header.parse_crs()
    assert crs.equals(pyproj.CRS(code), ignore_axis_order=True) or crs.name == pyproj.CRS(code).name
    if code.startswith("EPSG:2263"):
        assert {axis.unit_name.lower() for axis in crs.axis_info} <= {"us survey foot", "foot"}


def test_axes_of_the_user_give_coordinates_without_a_system(placed):
    out, points = placed(MapPlace("local", (100.0, -50.0, 7.0)))
    x, y, z = points.T
    check(out, points, np.column_stack([x + 100.0, -z - 50.0, y + 7.0]), None)
    assert laspy.read(out / "cloud.laz").header.parse_crs() is None


def test_models_stay_near_zero_with_their_place_beside_them(placed):
    out, _ = placed(MapPlace("EPSG:4979", (LON, LAT, HEIGHT), 30.0))
    cloud = sfm_app.export_scene(out, "cloud-ply", out / "files" / "cloud.ply")
    record = json.loads((cloud.parent / "export.json").read_text())
    assert record["map"]["system"] == "EPSG:32632" and "files" not in record
    assert b"element vertex 400" in cloud.read_bytes()[:200]
    folder = sfm_app.export_scene(out, "colmap")
    assert json.loads((folder / "export.json").read_text())["map"] == record["map"]
    store(Workspace(out), MetricFrame())
    sfm_app.export_scene(out, "cloud-ply", cloud)
    assert "map" not in json.loads((cloud.parent / "export.json").read_text())
