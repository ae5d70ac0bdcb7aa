"""Contours of surfaces whose lines of equal height are known, read back from the bytes of the GeoPackage."""

import sqlite3
import struct

import numpy as np
import pytest
import rasterio
from click.testing import CliRunner

from sfm_app.cli.program import main
from sfm_app.errors import ConfigError, InputError
from sfm_app.frame.scale import MetricFrame
from sfm_app.maps.contours import find_contours, write_geopackage
from sfm_app.maps.drawing import Grid, Tile
from sfm_app.maps.products import MapOptions, export_map
from sfm_app.types import MapPlace
from tests.unit.maps.conftest import HOUSE

SYSTEM = 'PROJCS["mine",GEOGCS["WGS 84",DATUM["WGS_1984",SPHEROID["WGS 84",6378137,298.257223563]],' \
    'PRIMEM["Greenwich",0],UNIT["degree",0.0174532925199433]],PROJECTION["Transverse_Mercator"],' \
    'PARAMETER["latitude_of_origin",0],PARAMETER["central_meridian",8.5],PARAMETER["scale_factor",1],' \
    'PARAMETER["false_easting",1000],PARAMETER["false_northing",0],UNIT["metre",1]]'  # fmt: skip


def read(path):
    """Heights and lines, the number of their system, and the rows of contents and systems."""
    base = sqlite3.connect(path)
    lines = []
    for geometry, height in base.execute("SELECT geom, height FROM contours ORDER BY fid"):
        magic, _, flags, system = struct.unpack("<2sBBi", geometry[:8])
        x0, x1, y0, y1 = struct.unpack("<4d", geometry[8:40])
        order, kind, count = struct.unpack("<BII", geometry[40:49])
        line = np.frombuffer(geometry[49:], "<f8").reshape(count, 2)
        assert (magic, flags, order, kind) == (b"GP", 3, 1, 2)
        assert (x0, y0, x1, y1) == (*line.min(axis=0), *line.max(axis=0))
        lines.append((height, line, system))
    contents = base.execute("SELECT * FROM gpkg_contents").fetchall()
    systems = {row[1]: row for row in base.execute("SELECT * FROM gpkg_spatial_ref_sys")}
    marks = [base.execute(f"PRAGMA {name}").fetchone()[0] for name in ("application_id", "user_version")]
    base.close()
    assert marks == [0x47504B47, 10300] and {-1, 0, 4326} <= set(systems)
    return lines, contents[0], systems


def cone(hole=False):
    """A cone of height 10 over a circle of radius 20 around (100, -50), in two tiles of a grid."""
    grid = Grid(70.0, -20.0, 0.5, 120, 120)
    x, y = np.meshgrid(70.25 + 0.5 * np.arange(120), -20.25 - 0.5 * np.arange(120))
    heights = (10.0 - np.hypot(x - 100.0, y + 50.0) / 2.0).astype(np.float32)
    if hole:
        heights[:, 60:] = np.nan
    none = np.zeros((0, 0, 4), np.uint8)
    return (Tile(0, 0, none, heights[:70]), Tile(70, 0, none, heights[70:])), grid


@pytest.mark.parametrize("hole", [False, True])
def test_contours_of_a_cone_are_circles(tmp_path, hole):
    tiles, grid = cone(hole)
    write_geopackage(find_contours(tiles, grid, 2.0), SYSTEM, tmp_path / "lines.gpkg")
    lines, contents, systems = read(tmp_path / "lines.gpkg")
    assert {height for height, _, _ in lines} == {-10.0, -8.0, -6.0, -4.0, -2.0, 0.0, 2.0, 4.0, 6.0, 8.0}
    for height, line, system in lines:
        radius = np.hypot(line[:, 0] - 100.0, line[:, 1] + 50.0)
        assert np.abs(radius - 2.0 * (10.0 - height)).max() < 0.05
        assert not hole or line[:, 0].max() <= 99.75
        assert system == contents[-1] and systems[system][0] == "mine" and systems[system][4] == SYSTEM
    high = [line for height, line, _ in lines if height == 8.0]
    assert hole or (len(high) == 1 and (high[0][0] == high[0][-1]).all())
    everything = np.concatenate([line for _, line, _ in lines])
    assert contents[5:9] == (*everything.min(axis=0), *everything.max(axis=0))


@pytest.mark.parametrize(("scale", "step"), [(1.0, 0.5), (0.01, 0.005), (30.0, 20.0)])
def test_a_round_interval_gives_twenty_heights_or_more(scale, step):
    """The middle 98 % of the cone's heights span 19, and of the others 30 times and a hundredth of it."""
    tiles, grid = cone()
    scaled = [Tile(tile.row, tile.column, tile.colors, tile.heights * np.float32(scale)) for tile in tiles]
    heights = sorted({height for height, _ in find_contours(scaled, grid)})
    assert np.diff(heights) == pytest.approx(np.full(len(heights) - 1, step))
    assert 20 <= len(heights) < 60


def test_too_many_heights_are_refused_and_none_are_no_lines(tmp_path):
    tiles, grid = cone()
    with pytest.raises(InputError, match="heights") as caught:
        list(find_contours(tiles, grid, 0.0005))
    assert "--interval" in caught.value.hint
    write_geopackage(find_contours((), grid), "", tmp_path / "none.gpkg")
    lines, contents, _ = read(tmp_path / "none.gpkg")
    assert not lines and contents[5:] == (None, None, None, None, -1)


def test_contours_lie_on_the_orthophoto(tmp_path, make_run):
    """Lines between ground and roof run around the house, within a pixel of where colors change."""
    place = MapPlace("EPSG:32632", (320_000.0, 5_400_000.0, 512.0), 30.0)
    out = make_run(MetricFrame(deviation=0.01, source="GPS", place=place))
    (photo,) = export_map(out, "orthophoto", options=MapOptions("5cm"))
    command = ["export", str(out), "--format", "contours", "--interval", "1m", "--resolution", "5cm"]
    result = CliRunner().invoke(main, command)
    assert result.exit_code == 0, result.output
    lines, _, systems = read(out / "contours.gpkg")
    assert {height for height, _, _ in lines} == {513.0, 514.0} | {512.0, 515.0} & {height for height, _, _ in lines}
    assert 32632 in systems and systems[32632][2] == "EPSG"
    around = np.concatenate([line for height, line, _ in lines if 512.5 < height < 514.5])
    sine, cosine = 0.5, np.sqrt(0.75)
    east, north = around[:, 0] - 320_000.0, around[:, 1] - 5_400_000.0
    x, z = east * cosine - north * sine, -(east * sine + north * cosine)
    (x0, x1), (z0, z1) = HOUSE
    assert np.abs(np.min([x - x0, x1 - x, z - z0, z1 - z], axis=0)).max() < 0.05
    with rasterio.open(photo) as file:
        columns = ((around[:, 0] - file.transform.c) / 0.05).astype(int)
        rows = ((file.transform.f - around[:, 1]) / 0.05).astype(int)
        blue = file.read(3).astype(int)
    spans = [
        np.ptp(blue[row - 1 : row + 2, column - 1 : column + 2]) for row, column in zip(rows, columns, strict=True)
    ]
    assert len(spans) > 100 and min(spans) > 100


def test_same_run_same_bytes_and_the_default_in_units(make_run):
    out = make_run()
    (path,) = export_map(out, "contours")
    first = path.read_bytes()
    assert path.name == "contours.gpkg" and export_map(out, "contours")[0].read_bytes() == first
    lines, _, systems = read(path)
    assert {system for _, _, system in lines} == {-1} and max(systems) == 4326
    with pytest.raises(ConfigError, match="--interval: '1m'"):
        export_map(out, "contours", options=MapOptions(interval="1m"))
    with pytest.raises(ConfigError, match="--interval does not apply"):
        export_map(out, "dsm", options=MapOptions(interval="1"))
    assert [one.name for one in out.iterdir() if "contours" in one.name] == ["contours.gpkg"]
