"""Positions of drones in XMP, beside those in EXIF."""

from io import BytesIO

import numpy as np
import pytest
from PIL import Image
from PIL.TiffImagePlugin import IFDRational

from sfm_app.photos.decode import gps_position, read_picture, xmp_entries
from sfm_app.photos.probe import with_one_zero
from sfm_app.types import GpsPosition, Photo
from sfm_app.types.photos import FILE, SEA_LEVEL, TAKE_OFF

PIXELS = np.random.default_rng(1).integers(0, 255, (32, 48, 3), np.uint8)
HEAD = '<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF><rdf:Description rdf:about="DJI Meta Data" '
TAIL = "</rdf:RDF></x:xmpmeta>"
DJI = {
    "drone-dji:AbsoluteAltitude": "+512.34", "drone-dji:RelativeAltitude": "+60.10",
    "drone-dji:GpsLatitude": "46.123456789", "drone-dji:GpsLongitude": "-7.987654321",
}  # fmt: skip


def as_attributes(entries):
    return HEAD + " ".join(f'{name}="{value}"' for name, value in entries.items()) + "/>" + TAIL


def as_elements(entries):
    lines = "\n".join(f"<{name}>{value}</{name}>" for name, value in entries.items())
    return f"{HEAD}>{lines}</rdf:Description>{TAIL}"


def exif_with(seconds=None, altitude=None):
    exif = Image.Exif()
    if seconds is not None:
        exif.get_ifd(0x8825).update({1: "N", 2: (46.0, 7.0, seconds), 3: "W", 4: (7.0, 59.0, seconds)})
    if altitude is not None:
        exif.get_ifd(0x8825)[6] = altitude
    return exif


def read(tmp_path, xmp, name="a.jpg", exif=None):
    place, options = tmp_path / name, {} if exif is None else {"exif": exif}
    if name.endswith(".png"):
        from PIL.PngImagePlugin import PngInfo

        info = PngInfo()
        info.add_itxt("XML:com.adobe.xmp", xmp)
        Image.fromarray(PIXELS).save(place, pnginfo=info, **options)
    elif name.endswith(".tif"):
        Image.fromarray(PIXELS).save(place, tiffinfo={700: xmp.encode()}, **options)
    else:
        Image.fromarray(PIXELS).save(place, xmp=xmp.encode(), **options)
    picture = read_picture(place)
    return gps_position(picture.exif, xmp_entries(picture.image, picture.exif))


@pytest.mark.parametrize("form", [as_attributes, as_elements])
@pytest.mark.parametrize("name", ["a.jpg", "a.png", "a.tif", "a.webp"])
def test_the_position_of_a_drone_is_read_from_every_format(tmp_path, name, form):
    found = read(tmp_path, form(DJI), name)
    assert found == GpsPosition(46.123456789, -7.987654321, 512.34)


@pytest.mark.parametrize(
    ("entries", "position"),
    [
        ({"drone-dji:GpsLatitude": "+46.5", "drone-dji:GpsLongtitude": "+7.25"}, (46.5, 7.25, None)),
        ({"exif:GPSLatitude": "46,30.123N", "exif:GPSLongitude": "7,15.5W"}, (46.50205, -7.2583333, None)),
        ({"exif:GPSLatitude": "46,30,36S", "exif:GPSLongitude": "7,15,18E"}, (-46.51, 7.255, None)),
        ({"exif:GPSLatitude": "46,30.0N", "exif:GPSLongitude": "7,15.0E", "exif:GPSAltitude": "12345/100",
          "exif:GPSAltitudeRef": "1"}, (46.5, 7.25, -123.45)),
        ({"exif:GPSLatitude": "46,30.0E", "exif:GPSLongitude": "7,15.0N"}, None),
        ({"drone-dji:GpsLatitude": "0.0", "drone-dji:GpsLongitude": "0.0"}, None),
        ({"drone-dji:GpsLatitude": "96.0", "drone-dji:GpsLongitude": "7.0"}, None),
        ({"drone-dji:GpsLatitude": "nan", "drone-dji:GpsLongitude": "7.0"}, None),
        ({"drone-dji:GpsLatitude": "46.0"}, None),
        ({"other:GpsLatitude": "46.0", "other:GpsLongitude": "7.0"}, None),
    ],
)  # fmt: skip
def test_spellings_of_makers(tmp_path, entries, position):
    for form in (as_attributes, as_elements):
        found = read(tmp_path, form(entries))
        if position is None:
            assert found is None
        else:
            assert (found.latitude_deg, found.longitude_deg) == pytest.approx(position[:2], abs=1e-7)
            assert found.altitude_m == position[2] and found.zero == SEA_LEVEL


def test_exif_has_priority(tmp_path):
    found = read(tmp_path, as_attributes(DJI), exif=exif_with(IFDRational(24, 1)))
    assert found.latitude_deg == pytest.approx(46 + 7 / 60 + 24 / 3600, abs=1e-9)


def test_deviations_are_kept(tmp_path):
    rtk = {"drone-dji:RtkStdLat": "0.011", "drone-dji:RtkStdLon": "0.014", "drone-dji:RtkStdHgt": "0.03"}
    found = read(tmp_path, as_attributes(DJI | rtk))
    assert (found.deviation_m, found.altitude_deviation_m) == (0.014, 0.03)
    parrot = {"Camera:GPSXYAccuracy": "1.26", "Camera:GPSZAccuracy": "2.5"}
    found = read(tmp_path, as_elements(parrot), exif=exif_with(IFDRational(12, 1)))
    assert (found.deviation_m, found.altitude_deviation_m) == (1.26, 2.5)


def test_heights_above_the_take_off_are_told_apart(tmp_path):
    only = {name: value for name, value in DJI.items() if "Absolute" not in name}
    found = read(tmp_path, as_attributes(only))
    assert (found.altitude_m, found.zero) == (60.1, TAKE_OFF)
    found = read(tmp_path, as_attributes(only), exif=exif_with(IFDRational(12, 1), 498.0))
    assert (found.altitude_m, found.zero) == (498.0, SEA_LEVEL)


def photos_with(*zeros):
    return [Photo(f"{k}.jpg", 9, 9, "", gps=GpsPosition(46.0, 7.0, 5.0, zero)) for k, zero in enumerate(zeros)]


@pytest.mark.parametrize(
    ("zeros", "kept"),
    [((SEA_LEVEL, TAKE_OFF), [0]), ((TAKE_OFF, SEA_LEVEL, TAKE_OFF), [0, 2]), ((SEA_LEVEL, FILE, SEA_LEVEL), [1]),
     ((TAKE_OFF, TAKE_OFF), [0, 1])],
)  # fmt: skip
def test_a_set_has_altitudes_of_one_kind(zeros, kept):
    found = with_one_zero(photos_with(*zeros))
    assert [k for k, photo in enumerate(found) if photo.gps.altitude_m is not None] == kept
    assert len({photo.gps.zero for photo in found}) == 1


def test_damaged_xmp_gives_a_value_or_none():
    rng, signs = np.random.default_rng(3), np.frombuffer(b"<>=\"'/:&;,.0129eE+-\x00\xff", np.uint8)
    for form in (as_attributes, as_elements):
        sound = form(DJI).encode()
        for _ in range(200):
            data = bytearray(sound)
            for at in rng.integers(0, len(sound) - 20, rng.integers(1, 13)):
                data[at : at + rng.integers(0, 4)] = bytes(rng.choice(signs, rng.integers(0, 7)))
            image = Image.open(BytesIO(_jpeg(bytes(data))))
            found = gps_position(image.getexif(), xmp_entries(image))
            assert found is None or (abs(found.latitude_deg) <= 90 and abs(found.longitude_deg) <= 180)


def _jpeg(xmp):
    file = BytesIO()
    Image.fromarray(PIXELS).save(file, "JPEG", xmp=xmp)
    return file.getvalue()


@pytest.mark.parametrize("data", [b"<a:b " * 60_000, b'a:b="' * 60_000, b"a" * 300_000, b"<!ENTITY a '&b;&b;'>" * 9000])
def test_hostile_xmp_takes_no_time(data):
    image = Image.new("RGB", (8, 8))
    image.info["xmp"] = data
    assert not any(name.startswith("drone") for name in xmp_entries(image))
