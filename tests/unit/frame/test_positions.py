"""Files of positions of photos: OpenDroneMap's geo.txt, and tables of other programs."""

import numpy as np
import pytest

from sfm_app.errors import InputError
from sfm_app.frame.positions import read_positions
from sfm_app.types import GpsPosition
from sfm_app.types.photos import FILE
from tests.unit.frame.test_coordinates import SYSTEMS

FILES = ("a.jpg", "sub/b 1.jpg", "c.JPG", "geo.txt")


def read(tmp_path, text, files=FILES, encoding="utf-8"):
    place = tmp_path / "geo.txt"
    place.write_text(text, encoding=encoding)
    return read_positions(place, files)


@pytest.mark.parametrize(
    "text",
    ["EPSG:4326\na.jpg 9.5 46.5 400\nsub/b 1.jpg 9.6 46.6 410\n",
     "WGS84\n\n# remark\na.jpg\t9.5\t46.5\t400\nb 1.jpg\t9.6\t46.6\t410\n",
     "+proj=longlat +datum=WGS84 +no_defs\nA 9.5 46.5 400\nB 1.JPG 9.6 46.6 410\n",
     "#Label,X/Longitude,Y/Latitude,Z/Altitude,Accuracy\na.jpg,9.5,46.5,400,3\nb 1.jpg,9.6,46.6,410,3\n",
     'name;latitude;longitude;alt\n"a.jpg";46.5;9.5;400\n"b 1.jpg";46.6;9.6;410\n'],
)  # fmt: skip
@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16"])
def test_spellings_of_the_file(tmp_path, text, encoding):
    found, missing = read(tmp_path, text, encoding=encoding)
    assert not missing
    assert found == {"a.jpg": GpsPosition(46.5, 9.5, 400.0, FILE), "sub/b 1.jpg": GpsPosition(46.6, 9.6, 410.0, FILE)}


@pytest.mark.parametrize(
    ("numbers", "altitude_m", "deviations"),
    [("9.5 46.5", None, (None, None)), ("9.5 46.5 7", 7.0, (None, None)), ("9.5 46.5 7 1 2 3", 7.0, (None, None)),
     ("9.5 46.5 7 1 2 3 0.02 0.05", 7.0, (0.02, 0.05)), ("9.5 46.5 7 1 2 3 0 0", 7.0, (None, None))],
)  # fmt: skip
def test_heights_and_deviations_are_optional(tmp_path, numbers, altitude_m, deviations):
    found = read(tmp_path, f"EPSG:4326\na.jpg {numbers}\n")[0]["a.jpg"]
    assert found.altitude_m == altitude_m
    assert (found.deviation_m, found.altitude_deviation_m) == deviations


@pytest.mark.parametrize("code", [code for code, (_, _, form) in SYSTEMS.items() if "\n" not in code])
def test_positions_of_every_system_become_wgs84(tmp_path, code):
    (lon_deg, lat_deg), _, project = SYSTEMS[code]
    lon, lat = np.radians([lon_deg, lat_deg])
    x, y, z = (float(np.squeeze(value)) for value in project(np.array([lon]), np.array([lat]), np.array([300.0])))
    found = read(tmp_path, f"{code}\na.jpg {x!r} {y!r} {z!r}\n")[0]["a.jpg"]
    datum_shift_deg = 0.003 if code == "EPSG:31467" else 2e-8
    assert found.latitude_deg == pytest.approx(lat_deg, abs=datum_shift_deg)
    assert (found.longitude_deg - lon_deg + 180.0) % 360.0 == pytest.approx(180.0, abs=datum_shift_deg)
    assert found.altitude_m == pytest.approx(300.0, abs=1e-3)


def test_photos_that_are_not_there_are_named(tmp_path):
    found, missing = read(tmp_path, "EPSG:4326\na.jpg 9.5 46.5 4\nd.jpg 9.5 46.5 4\n")
    assert set(found) == {"a.jpg"} and missing == ["d.jpg"]


@pytest.mark.parametrize(
    ("text", "says"),
    [("", "names no coordinate system"),
     ("EPSG:4326\n", "holds no position"),
     ("a.jpg 9.5 46.5 400\n", "line 1: 'a.jpg 9.5 46.5 400' is no coordinate system"),
     ("hello world\na.jpg 9.5 46.5\n", "line 1: 'hello world'"),
     ("EPSG:4326\na.jpg 9.5 46.5\na.jpg 9.5\n", "line 3 is malformed"),
     ("EPSG:4326\n\na.jpg 9.5 46.5 4 5\n", "line 3 is malformed"),
     ("EPSG:4326\na.jpg,9.5,north,3\n", "line 2 is malformed"),
     ("EPSG:4326\na.jpg 9.5 nan 3\n", "line 2 has a value out of range"),
     ("EPSG:4326\na.jpg 46.5 109.5 3\n", "line 2 has a position out of range .*longitude or east comes first: swap"),
     ("EPSG:32632\na.jpg 5149034 500123 3\n", "outside of the area of EPSG:32632: x and y are probably swapped"),
     ("EPSG:32632\na.jpg 500123 9149034000 3\n", "outside of the area of EPSG:32632: check the coordinate system"),
     ("EPSG:32632\na.jpg 9.5 46.5 3\n", "probably degrees, of EPSG:4326"),
     ("EPSG:4326\na.jpg 9.5 46.5\na.jpg 9.5 46.6\n", "line 3 gives 'a.jpg' another position"),
     ("EPSG:4326\nd.jpg 9.5 46.5\n", "the folder has no photo 'd.jpg'"),
     ("local\na.jpg 9.5 46.5 3\n", "no place on Earth")],
)  # fmt: skip
def test_wrong_files_are_refused_with_the_line(tmp_path, text, says):
    with pytest.raises(InputError, match=says) as caught:
        read(tmp_path, text)
    assert "east or longitude first" in caught.value.hint


def test_damaged_files_are_refused_or_give_positions(tmp_path):
    rng, refused = np.random.default_rng(5), 0
    signs = list("0123456789.,;-+eE \t\n#:ajpgnl\x00é")
    sound = "EPSG:32632\na.jpg 500123.5 5149034.1 400.2 1 2 3 0.02 0.05\nsub/b 1.jpg 500133.5 5149035.1 401 1 2 3 1 1\n"
    for _ in range(200):
        text = list(sound)
        for at in rng.integers(0, len(sound) - 30, rng.integers(1, 9)):
            text[at : at + rng.integers(0, 5)] = rng.choice(signs, rng.integers(0, 5))
        try:
            found, _ = read(tmp_path, "".join(text))
        except InputError:
            refused += 1
            continue
        for one in found.values():
            assert abs(one.latitude_deg) <= 90 and abs(one.longitude_deg) <= 180
    assert 20 < refused < 200
