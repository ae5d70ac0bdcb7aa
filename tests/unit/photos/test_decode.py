"""Formats, pixel depths, damage, and the focal length of EXIF."""

from pathlib import Path

import numpy as np
import PIL
import pytest
from PIL import Image, features
from PIL.ExifTags import IFD
from PIL.TiffImagePlugin import IFDRational

from sfm_app.operating_system import Ability, find_in_wheel
from sfm_app.photos.decode import FORMATS, UnreadableError, _install_handler, exif_prior, read_picture, upright_image

LIBTIFF = list(find_in_wheel(Path(PIL.__file__).parent, "pillow", "libtiff"))

BARS = np.repeat(np.arange(0, 256, 8, np.uint8)[None], 24, axis=0)
COLORS = np.stack([BARS, BARS[:, ::-1], 255 - BARS // 2], axis=-1)
LOSSLESS = {"PNG": {}, "TIFF": {"compression": "tiff_lzw"}, "BMP": {}, "WEBP": {"lossless": True}}


def decoded(path):
    return np.asarray(upright_image(read_picture(path)), int)


@pytest.mark.parametrize("kind", LOSSLESS)
def test_formats(tmp_path, kind):
    Image.fromarray(COLORS).save(tmp_path / "x", kind, **LOSSLESS[kind])
    assert np.array_equal(decoded(tmp_path / "x"), COLORS)


@pytest.mark.parametrize("options", [{"progressive": True}, {"optimize": True}, {"subsampling": 0}])
def test_jpeg(tmp_path, options):
    Image.fromarray(COLORS).save(tmp_path / "x.jpg", quality=98, **options)
    seen = decoded(tmp_path / "x.jpg")
    assert 0 < np.abs(seen - COLORS).mean() < 3


@pytest.mark.skipif(not features.check("avif"), reason="this Pillow has no AVIF")
def test_avif(tmp_path):
    Image.fromarray(COLORS).save(tmp_path / "x.avif", quality=95)
    assert np.abs(decoded(tmp_path / "x.avif") - COLORS).mean() < 5


def test_heic_is_read_where_the_extra_is_there(tmp_path):
    pytest.importorskip("pillow_heif").register_heif_opener()
    Image.fromarray(COLORS).save(tmp_path / "x.heic", quality=95)
    cut = (tmp_path / "x.heic").read_bytes()[:-60]
    (tmp_path / "cut.heic").write_bytes(cut)
    assert np.abs(decoded(tmp_path / "x.heic") - COLORS).mean() < 5
    with pytest.raises(UnreadableError, match=r"^truncated or damaged$"):
        read_picture(tmp_path / "cut.heic")


def test_heic_names_the_extra_where_it_is_not(tmp_path, monkeypatch):
    monkeypatch.setattr("sfm_app.photos.decode.formats", lambda: FORMATS)
    path = tmp_path / "IMG_0001.HEIC"
    path.write_bytes(b"\x00\x00\x00\x18ftypheic\x00\x00\x00\x00mif1heic" + bytes(50))
    with pytest.raises(UnreadableError, match=r"sfm-app\[heic\]"):
        read_picture(path)


@pytest.mark.parametrize("kind", ["PNG", "TIFF"])
@pytest.mark.parametrize("factor", [257, 10])
def test_sixteen_bits_become_eight_and_dark_ones_stay_dark(tmp_path, kind, factor):
    deep = BARS.astype(np.uint16) * factor
    Image.fromarray(deep).save(tmp_path / "x", kind)
    assert np.array_equal(decoded(tmp_path / "x"), deep // 257)


def test_floating_point_fills_the_range(tmp_path):
    Image.fromarray(BARS.astype(np.float32) / 100 - 1).save(tmp_path / "x.tif")
    seen = decoded(tmp_path / "x.tif")
    assert seen.min() == 0 and seen.max() == 255
    assert np.abs(seen - BARS.astype(int) * 255 / 248).max() <= 1


@pytest.mark.parametrize("alpha", [0, 200])
def test_what_is_transparent_takes_the_color_beside_it(tmp_path, alpha):
    clear = np.dstack([COLORS, np.where(BARS < 128, alpha, 255).astype(np.uint8)])
    clear[:, :16, :3] = 255
    Image.fromarray(clear).save(tmp_path / "x.png")
    seen = decoded(tmp_path / "x.png")
    assert np.array_equal(seen[:, 16:], COLORS[:, 16:])
    assert np.abs(seen[:, :16] - COLORS[:, 16:17]).max() < 8  # nothing is white


@pytest.mark.parametrize("kind", ["TIFF", "WEBP"])
def test_of_many_pictures_the_first(tmp_path, kind):
    first, second = Image.fromarray(COLORS), Image.fromarray(COLORS[:, ::-1])
    third = Image.fromarray(255 - COLORS)
    options = {"lossless": True} if kind == "WEBP" else {}
    first.save(tmp_path / "x", kind, save_all=True, append_images=[second, third], **options)
    picture = read_picture(tmp_path / "x")
    assert picture.frames == 3
    assert np.array_equal(np.asarray(upright_image(picture)), COLORS)


@pytest.mark.parametrize("kind", ["JPEG", "PNG", "TIFF", "WEBP", "BMP"])
@pytest.mark.parametrize("share", [0.3, 0.7])
def test_what_is_cut_off(tmp_path, kind, share):
    noise = np.random.default_rng(0).integers(0, 255, (64, 64, 3), np.uint8)
    Image.fromarray(noise).save(tmp_path / "x", kind)
    whole = (tmp_path / "x").read_bytes()
    (tmp_path / "x").write_bytes(whole[: int(share * len(whole))])
    with pytest.raises(UnreadableError, match=r"truncated or damaged|not a photo"):
        read_picture(tmp_path / "x")


@pytest.mark.parametrize("compression", ["group4", "jpeg"])
@pytest.mark.skipif(not LIBTIFF, reason="this Pillow has no libtiff of its own")
def test_what_libtiff_prints_makes_a_file_a_damaged_one(tmp_path, capfd, compression):
    noise = np.random.default_rng(0).integers(0, 255, (96, 128), np.uint8)
    image = Image.fromarray(noise).convert("1" if compression == "group4" else "RGB")
    image.save(tmp_path / "whole.tif", compression=compression)
    data = bytearray((tmp_path / "whole.tif").read_bytes())
    data[len(data) // 2 : len(data) // 2 + 40] = b"\xff\x07" * 20
    (tmp_path / "damaged.tif").write_bytes(data)

    with pytest.raises(UnreadableError, match=r"^truncated or damaged$"):
        read_picture(tmp_path / "damaged.tif")
    assert read_picture(tmp_path / "whole.tif").image.size == (128, 96)
    assert capfd.readouterr().err == ""


@pytest.mark.parametrize("compression", ["raw", "tiff_lzw", "jpeg"])
def test_without_a_libtiff_that_can_be_asked_a_file_that_breaks_off_is_still_a_damaged_one(
    tmp_path, without, compression
):
    without(Ability.WHEEL_LIBRARIES)
    _install_handler.cache_clear()
    Image.fromarray(np.random.default_rng(0).integers(0, 255, (96, 128, 3), np.uint8)).save(
        tmp_path / "whole.tif", compression=compression
    )
    data = (tmp_path / "whole.tif").read_bytes()
    (tmp_path / "cut.tif").write_bytes(data[: len(data) * 2 // 3])

    with pytest.raises(UnreadableError):
        read_picture(tmp_path / "cut.tif")
    assert read_picture(tmp_path / "whole.tif").image.size == (128, 96)
    _install_handler.cache_clear()


TAGS = {"MM": 0x920A, "EQUIVALENT": 0xA405, "WIDTH": 0xA002, "HEIGHT": 0xA003, "RESOLUTION": 0xA20E, "UNIT": 0xA210}


def claimed(longer_side, **tags):
    exif = Image.Exif()
    exif.get_ifd(IFD.Exif).update({TAGS[name]: value for name, value in tags.items()})
    prior = exif_prior(exif, longer_side)
    return prior and prior.focal_px


SENSOR = {"MM": 20.0, "WIDTH": 6000, "HEIGHT": 4000, "RESOLUTION": IFDRational(6000, 24), "UNIT": 4}
"""6000 px on 24 mm."""


def test_the_equivalent_counts_along_the_longer_side():
    assert claimed(3600, EQUIVALENT=28) == pytest.approx(2800.0)


def test_without_an_equivalent_the_resolution_of_the_sensor_counts():
    assert claimed(6000, **SENSOR) == pytest.approx(5000.0)
    assert claimed(1500, **SENSOR) == pytest.approx(1250.0)
    inches = SENSOR | {"RESOLUTION": 6000 / (24 / 25.4), "UNIT": 2}
    assert claimed(6000, **inches) == pytest.approx(5000.0)
    del inches["UNIT"]
    assert claimed(6000, **inches) == pytest.approx(5000.0)
    assert claimed(6000, **SENSOR, EQUIVALENT=0) == pytest.approx(5000.0)


@pytest.mark.parametrize(
    "tags",
    [{}, {"EQUIVALENT": 1}, {"EQUIVALENT": 60000}, {"EQUIVALENT": "wide"}, SENSOR | {"UNIT": 9}, SENSOR | {"MM": None},
     SENSOR | {"UNIT": "inch"}, SENSOR | {"RESOLUTION": IFDRational(6000, 0)}, SENSOR | {"WIDTH": 0, "HEIGHT": 0},
     {name: value for name, value in SENSOR.items() if name != "WIDTH"}],
)  # fmt: skip
def test_a_missing_or_implausible_focal_length_is_none(tags):
    assert claimed(6000, **tags) is None
