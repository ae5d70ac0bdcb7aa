"""Files of finished runs, read by GDAL, against formulas."""

import subprocess
import sys

import numpy as np
import pytest
import rasterio
from click.testing import CliRunner
from PIL import Image

from sfm_app.cli.program import main
from sfm_app.errors import ConfigError, InputError, ReconstructionError
from sfm_app.frame.scale import MetricFrame
from sfm_app.geometry.poses import Similarity
from sfm_app.maps.geotiff import HOLE
from sfm_app.maps.products import MapOptions, export_map
from sfm_app.types import MapPlace
from tests.unit.maps.conftest import GROUND, HALF, HOUSE, ROOF, TALL, WALL, gray_of

EAST, NORTH, ABOVE = 320_000.0, 5_400_000.0, 512.0
"""The scale of UTM is 1 here to 1e-5."""
METERS = MetricFrame(deviation=0.01, source="markers")


def placed(heading_deg=30.0, system="EPSG:32632", origin=(EAST, NORTH, ABOVE)):
    """A frame in meters at a place."""
    return MetricFrame(deviation=0.01, source="GPS", place=MapPlace(system, origin, heading_deg))


def read(path):
    """Bands (C, H, W), and x and y (H, W) of the pixels' centers."""
    with rasterio.open(path) as file:
        bands, to_map = file.read().astype(np.float64), file.transform
    columns, rows = np.meshgrid(np.arange(bands.shape[2]) + 0.5, np.arange(bands.shape[1]) + 0.5)
    return bands, to_map.c + to_map.a * columns, to_map.f + to_map.e * rows


def local(east, north, heading_deg):
    """x and z in the frame of exported files: -z points to the heading, clockwise from north."""
    sine, cosine = np.sin(np.radians(heading_deg)), np.cos(np.radians(heading_deg))
    return east * cosine - north * sine, -(east * sine + north * cosine)


def signed_distances(x, z):
    """Distance inside of the ground and of the house, in meters; negative outside."""
    (x0, x1), (z0, z1) = HOUSE
    house = np.min([x - x0, x1 - x, z - z0, z1 - z], axis=0)
    return HALF - np.maximum(np.abs(x), np.abs(z)), house


@pytest.mark.parametrize("heading_deg", [0.0, 30.0, 215.0])
def test_an_orthophoto_lies_on_the_map(make_run, heading_deg):
    (path,) = export_map(make_run(placed(heading_deg)), "orthophoto", options=MapOptions("5cm"))
    (red, green, blue, opacity), east, north = read(path)
    x, z = local(east - EAST, north - NORTH, heading_deg)
    ground, house = signed_distances(x, z)
    diagonal = 0.05 / np.sqrt(2.0)
    sure = np.abs(house) > diagonal
    inside = ground > diagonal
    assert (opacity[inside] == 255).all() and (opacity[ground < -diagonal] == 0).all()
    assert (np.abs(blue - np.where(house > 0, ROOF, GROUND))[inside & sure] <= 1).all()
    assert np.abs(red - gray_of(x))[inside & sure].max() < 1.1  # a pixel is 1.6 gray levels
    assert np.abs(green - gray_of(z))[inside & sure].max() < 1.1
    edge = inside & (np.abs(house) < 0.3 * 0.05)
    assert not heading_deg or 0.2 < ((blue[edge] - ROOF) / (GROUND - ROOF)).mean() < 0.8  # pixels on an edge are mixed
    border = (opacity > 0) & (opacity < 255)
    assert not heading_deg or border.sum() > 100
    assert opacity.sum() / 255.0 * 0.05**2 == pytest.approx((2.0 * HALF) ** 2, rel=0.001)
    assert {one.suffix for one in path.parent.iterdir() if "orthophoto" in one.name} == {".tif"}
    with rasterio.open(path) as file:
        assert file.crs.to_epsg() == 32632 and file.tags(ns="IMAGE_STRUCTURE")["LAYOUT"] == "COG"
        assert file.res == pytest.approx((0.05, 0.05), abs=1e-12) and file.colorinterp[3].name == "alpha"
        assert (file.transform.c / 0.05) % 1.0 == pytest.approx(0.0, abs=1e-4)


def test_heights_are_those_of_the_highest_surface_on_the_pixels_of_the_orthophoto(make_run):
    out = make_run(placed())
    (photo,) = export_map(out, "orthophoto", options=MapOptions("5cm"))
    (path,) = export_map(out, "dsm", options=MapOptions("5cm"))
    (heights,), east, north = read(path)
    ground, house = signed_distances(*local(east - EAST, north - NORTH, 30.0))
    assert (heights[ground < -0.001] == HOLE).all()
    known = (ground > 0.001) & (np.abs(house) > 0.001)
    assert np.abs(heights - (ABOVE + TALL * (house > 0)))[known].max() < 1e-3
    with rasterio.open(path) as dsm, rasterio.open(photo) as other:
        assert dsm.nodata == HOLE and dsm.units == ("m",)
        assert dsm.transform == other.transform and dsm.shape == other.shape


def test_lengths_are_in_the_units_of_the_system(make_run):
    """New York's grid has US survey feet, and its scale there is 1 to 1e-4."""
    foot = 1200.0 / 3937.0
    frame = placed(0.0, "EPSG:2263+8228", (987_000.0, 200_000.0, 40.0))
    (path,) = export_map(make_run(frame), "dsm", options=MapOptions("10cm"))
    with rasterio.open(path) as file:
        assert file.res[0] == pytest.approx(0.1 / foot, rel=1e-9) and file.units == ("ft",)
        assert file.width * file.res[0] * foot == pytest.approx(2.0 * HALF, abs=0.25)
        heights = file.read(1)
    assert heights.max() == pytest.approx(40.0 + TALL / foot, abs=0.01)


def test_the_highest_surface_wins_where_the_system_counts_depths(make_run):
    frame = placed(0.0, "EPSG:32632+5715", (EAST, NORTH, -ABOVE))  # depth of the sea
    (heights,), east, north = read(export_map(make_run(frame), "dsm", options=MapOptions("10cm"))[0])
    _, house = signed_distances(*local(east - EAST, north - NORTH, 0.0))
    assert np.abs(heights[house > 0.1] - (ABOVE + TALL)).max() < 0.01


def test_without_a_place_the_ground_is_a_plane_in_meters(make_run):
    (path,) = export_map(make_run(METERS), "orthophoto", options=MapOptions("5cm"))
    bands, x, y = read(path)
    inside = signed_distances(x, -y)[0] > 0.05
    assert np.abs(bands[0] - gray_of(x))[inside].max() < 1.1 and np.abs(bands[1] - gray_of(-y))[inside].max() < 1.1
    with rasterio.open(path) as file:
        assert file.crs.to_wkt().startswith("LOCAL_CS[") and 'UNIT["metre",1' in file.crs.to_wkt()


def test_the_frame_of_exported_files_counts(make_run):
    moved = MetricFrame(Similarity(2.0, np.eye(3), np.array([1.0, 5.0, -3.0])), 0.01, "markers")
    (heights,), x, y = read(export_map(make_run(moved), "dsm", options=MapOptions("5cm"))[0])
    _, house = signed_distances((x - 1.0) / 2.0, (-y + 3.0) / 2.0)
    assert heights[house > 0.01] == pytest.approx(5.0 + 2.0 * TALL)


def test_without_a_size_lengths_are_refused_and_numbers_taken(make_run):
    out = make_run()
    with pytest.raises(ConfigError, match="2cm") as caught:
        export_map(out, "dsm", options=MapOptions("2cm"))
    assert "--markers" in caught.value.hint
    with rasterio.open(export_map(out, "dsm", options=MapOptions("0.1"))[0]) as file:
        assert file.res == pytest.approx((0.1, 0.1)) and file.crs is None and file.units in ((None,), ("",))


@pytest.mark.parametrize(("text", "scaled"), [("5", True), ("0cm", True), ("-1", False), ("nan", False), ("x", False)])
def test_bad_resolutions(make_run, text, scaled):
    with pytest.raises(ConfigError, match="--resolution"):
        export_map(make_run(METERS if scaled else None), "dsm", options=MapOptions(text))


def test_by_default_a_pixel_is_a_texel_of_the_photos(make_run):
    (path,) = export_map(make_run(METERS), "orthophoto")
    with rasterio.open(path) as file:
        assert file.res[0] == pytest.approx(2.0 * HALF / 256.0, rel=1e-6)


def test_it_says_where_the_raster_lies_and_what_the_texture_leaves_out(make_run):
    steps = []
    export_map(make_run(METERS, texels_per_pixel=0.5), "dsm", progress=lambda step: steps.append(step.label))
    assert any("ground plane" in text and "3.125 cm" in text and "2 times as fine" in text for text in steps)
    steps.clear()
    export_map(make_run(placed()), "dsm", progress=lambda step: steps.append(step.label))
    assert any("UTM zone 32N" in text and "fine" not in text for text in steps)


def test_a_wall_from_its_front_with_its_page(make_run):
    """The wall at +z shows x to the right; its texture is red from left to right."""
    paths = export_map(make_run(METERS), "orthophoto", options=MapOptions("2cm", "-1,0,0.5 1,0,0.5 1,1,0.5"))
    assert [path.name for path in paths] == [f"orthophoto-plane.{suffix}" for suffix in ("tif", "png", "pdf")]
    (red, green, blue, opacity), x, y = read(paths[0])
    (x0, x1), _ = HOUSE
    inside = np.min([x - x0, x1 - x, y, TALL - y], axis=0) > 0.02
    assert inside.sum() > 10_000 and (opacity[inside] == 255).all() and (np.abs(blue[inside] - WALL) <= 1).all()
    assert np.abs(red - gray_of(x))[inside].max() < 1.1 and np.abs(green - gray_of(y))[inside].max() < 1.1
    assert (opacity[(y < -0.02) | (x < x0 - 0.02)] == 0).all()


def test_a_section_shows_what_lies_behind_it(make_run):
    """A slanting line cuts the walls at z = 0.5 and at x = 1.5: of both, the part behind it shows."""
    options = MapOptions("2cm", "-0.75,0,1.5 1.25,0,-0.5")
    (heights,), u, y = read(export_map(make_run(METERS), "dsm", options=options)[0])
    root = np.sqrt(2.0)
    front = (u > -1.5 / root) & (u < -0.25 / root)
    side = (u > 2.25 / root) & (u < 3.5 / root)
    tall = (y > 0.02) & (y < TALL - 0.02)
    near = np.min([np.abs(u - end / root) for end in (-1.5, -0.25, 2.25, 3.5)], axis=0) < 0.02
    expected = np.where(front, u + 0.25 / root, 2.25 / root - u)
    for part in (front, side):
        assert np.abs(heights - expected)[part & tall & ~near].max() < 1e-5
    assert (heights[~front & ~side & ~near] == HOLE).all()


def test_sheets_are_to_scale(make_run):
    """An 8 m wide picture fits on A3 at 1 : 20, 400 mm; at 1 : 10 it does not."""
    _, png, pdf = export_map(make_run(METERS), "orthophoto", options=MapOptions("2cm", "-4,0,4 4,0,4 4,0,-4"))
    page = Image.open(png)
    dots = 8.0 / 50.0 / 0.0254 * page.info["dpi"][0]
    colored = np.flatnonzero((np.asarray(page).astype(int).std(axis=2) > 20).any(axis=0))
    assert colored[-1] - colored[0] == pytest.approx(dots, rel=0.02)
    assert pdf.read_bytes().startswith(b"%PDF") and b"Date" not in pdf.read_bytes()


def test_same_run_same_bytes(make_run):
    out, options = make_run(METERS), MapOptions("5cm", "facade")
    first = [path.read_bytes() for path in export_map(out, "dsm", options=options)]
    assert [path.read_bytes() for path in export_map(out, "dsm", options=options)] == first


def test_the_command_line_takes_points_with_a_minus(make_run, tmp_path):
    out, target = make_run(METERS), tmp_path / "wall.tif"
    points = ["-1,0,0.5", "1,0,0.5", "-1,1,0.5"]
    arguments = ["export", str(out), "--plane", *points, "--format", "orthophoto", "--resolution", "2cm"]
    result = CliRunner().invoke(main, [*arguments, "-o", str(target)])
    assert result.exit_code == 0, result.output
    joined = export_map(out, "orthophoto", options=MapOptions("2cm", " ".join(points)))
    assert target.read_bytes() == joined[0].read_bytes()


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["--format", "obj", "--plane", "facade"], "--plane does not apply"),
        (["--format", "obj", "--resolution", "2cm"], "--resolution does not apply"),
        (["--format", "dsm", "--points"], "--points does not apply"),
        (["--format", "dsm", "--plane", "0,0,0"], "1 points"),
        (["--format", "dsm", "--plane", "0,0,0 1,1,x"], "'1,1,x' is no point"),
        (["--format", "dsm", "--plane", "0,0,0 0,2,0"], "vertical line"),
        (["--format", "dsm", "--plane", "0,0,0 1,0,0 2,0,0"], "one line"),
        (["--format", "dsm", "-o", "map.png"], "does not end in .tif"),
    ],
)
def test_bad_commands(make_run, arguments, says, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    result = CliRunner().invoke(main, ["export", str(make_run(METERS)), *arguments])
    assert result.exit_code == 2 and says in result.output and "hint:" in result.output


def test_a_bad_plane_is_named_before_files_are_read(tmp_path):
    with pytest.raises(ConfigError, match="no point"):
        export_map(tmp_path / "none", "dsm", options=MapOptions("", "left wall"))
    with pytest.raises(InputError):
        export_map(tmp_path / "none", "dsm", options=MapOptions("", "facade"))


def test_a_typing_error_of_the_resolution_is_an_error_and_leaves_no_file(make_run):
    out = make_run(METERS)
    with pytest.raises(InputError, match="pixels"):
        export_map(out, "dsm", options=MapOptions("0.001mm"))
    with pytest.raises(ReconstructionError, match="faces the viewer"):
        export_map(out, "dsm", options=MapOptions("1cm", "4,0,4 -4,0,4 4,0,-4"))
    assert not [path for path in out.iterdir() if ".tif" in path.name or path.name.startswith(".dsm")]


def test_what_cannot_be_written_names_the_target(make_run, tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match=r"cannot write .*map\.tif"):
        export_map(make_run(METERS), "dsm", tmp_path / "file" / "map.tif")


FULL_DISK = """
import resource, signal, sys
from pathlib import Path
from sfm_app.errors import InputError
from sfm_app.maps.products import MapOptions, export_map
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
out, whole = Path(sys.argv[1]), Path(sys.argv[2]).read_bytes()
for size in range(500, 8 * len(whole), len(whole) // 10):
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, resource.RLIM_INFINITY))
    try:
        (path,) = export_map(out, "orthophoto", out / "small.tif", MapOptions("10cm"))
    except InputError as err:
        assert "small.tif" in str(err) and not (out / "small.tif").exists(), err
        print("refused")
    else:
        assert path.read_bytes() == whole
        path.unlink()
        print("whole")
    assert not [one for one in out.iterdir() if "small" in one.name]
"""


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no limits on files")
def test_a_full_disk_gives_an_error_or_the_whole_file(make_run):
    out = make_run(METERS)
    (whole,) = export_map(out, "orthophoto", options=MapOptions("10cm"))
    command = [sys.executable, "-c", FULL_DISK, str(out), str(whole)]
    said = subprocess.run(command, check=False, capture_output=True, text=True, timeout=120)
    assert said.returncode == 0, said.stderr
    results = said.stdout.split()
    assert results == sorted(results) and set(results) == {"refused", "whole"}


def test_without_rasterio_it_says_what_to_install(make_run, monkeypatch):
    monkeypatch.setitem(sys.modules, "rasterio", None)
    with pytest.raises(ConfigError, match="rasterio") as caught:
        export_map(make_run(METERS), "dsm")
    assert caught.value.hint == "pip install 'sfm-app[maps]'"
