"""The focal length that EXIF claims, in pixels."""

import pytest
from PIL import Image
from PIL.ExifTags import IFD
from PIL.TiffImagePlugin import IFDRational

from sfm_app.photos.decode import focal_px

MM, EQUIVALENT, WIDTH, HEIGHT, RESOLUTION, UNIT = 0x920A, 0xA405, 0xA002, 0xA003, 0xA20E, 0xA210


def claimed(longer_side, **tags):
    exif = Image.Exif()
    exif.get_ifd(IFD.Exif).update({globals()[name]: value for name, value in tags.items()})
    return focal_px(exif, longer_side)


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
    [
        {},
        {"EQUIVALENT": 1},
        {"EQUIVALENT": 60000},
        {"EQUIVALENT": "wide"},
        SENSOR | {"UNIT": 9},
        SENSOR | {"UNIT": "inch"},
        SENSOR | {"RESOLUTION": IFDRational(6000, 0)},
        SENSOR | {"WIDTH": 0, "HEIGHT": 0},
        SENSOR | {"MM": None},
        {name: value for name, value in SENSOR.items() if name != "WIDTH"},
    ],
)
def test_what_is_missing_or_implausible_claims_nothing(tags):
    assert claimed(6000, **tags) is None
