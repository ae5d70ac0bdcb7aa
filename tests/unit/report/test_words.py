import numpy as np
import pytest

from sfm_app.camera.bearings import field_of_view_deg
from sfm_app.camera.models import camera_matrix
from sfm_app.report.text import center_text, field_text, focal_text, held_text, lens_text, verdict
from sfm_app.types import Calibration


def camera(fx=500.0, fy=500.0, cx=500.0, cy=400.0, **values):
    found = {"method": "zero-curves", "identifiable": True} | values
    return Calibration(camera_matrix(fx, fy, cx, cy), 1000, 800, **found)


def test_the_field_of_view_counts_from_the_optical_center():
    across, down = field_of_view_deg(camera(cx=0.0))

    assert across == pytest.approx(np.degrees(np.arctan(2.0)))
    assert down == pytest.approx(2 * np.degrees(np.arctan(0.8)))


def test_the_focal_says_how_sure_it_is_and_how_wide_it_sees():
    assert focal_text(camera(spread={"fx": 2.4})) == (
        "Focal length 500 px +- 2: the camera sees 90 degrees from left to right, 77 from top to bottom."
    )
    assert "pixels are 1.250 times as high as wide" in focal_text(camera(fx=625.0))
    assert "pixels" not in focal_text(camera(fx=501.0, held=("aspect",)))


def test_wide_lenses_say_what_they_see():
    wide = camera(fx=400.0, fy=400.0, projection="fisheye", fisheye=(0.0, 0.0, 0.0, 0.0))
    narrow = camera(fx=900.0, fy=900.0, projection="fisheye", fisheye=(0.0, 0.0, 0.0, 0.0))
    panorama = camera(projection="equirectangular")

    assert focal_text(wide) == (
        "Focal length 400 px: a fisheye that sees 143 degrees from left to right, 115 from top to bottom."
    )
    assert field_text(narrow) == "sees 64 degrees from left to right, 51 from top to bottom"
    assert focal_text(panorama) == "360-degree panoramas, 1000 x 800 px." and center_text(panorama) == ""
    assert verdict(camera(method="given")).startswith("Given: ")


def test_distortion_widens_the_field():
    assert "sees 98 degrees" in field_text(camera(radial=-0.1))


@pytest.mark.parametrize(
    ("cx", "cy", "says"),
    [
        (500.2, 399.8, "in the middle of the photo."),
        (492.0, 404.0, "8 px left of and 4 px below the middle of the photo."),
        (508.0, 396.0, "8 px right of and 4 px above the middle of the photo."),
    ],
)
def test_the_center_is_told_from_the_middle(cx, cy, says):
    assert center_text(camera(cx=cx, cy=cy)) == f"Optical center {says}"


def test_a_guess_says_what_it_is_and_why():
    text = verdict(camera(identifiable=False, method="exif", reason="an orbit"))

    assert text == "Not known: these photos do not determine the camera: an orbit. Its values are from EXIF."


def test_a_lens_and_what_is_held_are_told_only_where_there_is_something_to_tell():
    plain, bent = camera(), camera(radial=-0.12, spread={"k1": 0.004}, held=("center", "aspect"))

    assert (lens_text(plain), held_text(plain)) == ("", "")
    assert lens_text(bent) == "The lens bends lines outwards (barrel), k1 -0.120 +- 0.004."
    assert held_text(bent).endswith("optical center near the middle of the photo, square pixels.")
    assert held_text(camera(held=("center",), identifiable=False)) == ""
    assert lens_text(camera(radial=-0.003, held=("k1",))) == ""


def test_no_direction_is_told_of_a_distortion_within_its_deviation():
    assert lens_text(camera(radial=0.002, spread={"k1": 0.004})) == "The lens hardly bends lines, k1 0.002 +- 0.004."
    assert "pincushion" in lens_text(camera(radial=0.009, spread={"k1": 0.004}))
