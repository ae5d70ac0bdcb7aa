"""The curve of a lens, and the field of view that follows from it."""

import numpy as np
import pytest

from sfm_app.camera.bearings import RAY, bearings, corner_angle, field_of_view_deg, radius_deviation_px, radius_px
from sfm_app.camera.models import calibration_from_model, camera_matrix, panorama_matrix
from sfm_app.types import Calibration

SIZE = (1000, 800)
PANORAMA = Calibration(panorama_matrix((1000, 500)), 1000, 500, "panorama", True, projection="equirectangular")


def model(name, *params):
    return calibration_from_model(name, params, SIZE)


@pytest.mark.parametrize(
    "camera",
    [
        model("SIMPLE_PINHOLE", 500.0, 500.0, 400.0),
        model("SIMPLE_RADIAL", 500.0, 500.0, 400.0, -0.08),
        model("FULL_OPENCV", 500.0, 500.0, 500.0, 400.0, -0.1, 0.02, 0.0, 0.0, 0.001, 0.02, 0.0, 0.0),
        model("RADIAL_FISHEYE", 350.0, 500.0, 400.0, -0.02, 0.003),
    ],
)
def test_the_curve_is_that_of_the_rays(camera):
    x = np.column_stack([np.linspace(500.0, 990.0, 40), np.full(40, 400.0)])
    rays = bearings(x, camera)[:, RAY]

    radius = radius_px(np.arctan2(rays[:, 0], rays[:, 2]), camera)

    assert np.abs(radius - (x[:, 0] - 500.0)).max() < 1e-6


def test_a_lens_shows_nothing_behind_its_fold_or_behind_itself():
    barrel = model("SIMPLE_RADIAL", 500.0, 500.0, 400.0, -0.2)

    assert np.isnan(radius_px(np.array([1.5, 1.6, 2.0]), barrel)).all()
    assert np.isfinite(radius_px(np.array([2.0]), model("SIMPLE_FISHEYE", 200.0, 500.0, 400.0))).all()
    assert radius_px(np.array([np.pi]), PANORAMA) == pytest.approx([500.0])


def test_the_field_counts_what_the_lens_shows():
    assert field_of_view_deg(model("SIMPLE_PINHOLE", 500.0, 500.0, 400.0))[0] == pytest.approx(90.0)
    assert field_of_view_deg(model("SIMPLE_FISHEYE", 500.0 / np.radians(60.0), 500.0, 400.0)) == pytest.approx(
        (120.0, 96.0)
    )
    assert field_of_view_deg(model("SIMPLE_RADIAL", 500.0, 500.0, 400.0, -0.1))[0] > 95.0
    assert field_of_view_deg(PANORAMA) == (360.0, 180.0)
    beside = Calibration(camera_matrix(500.0, 500.0, -100.0, 400.0), *SIZE, "given", True)
    assert field_of_view_deg(beside)[0] == pytest.approx(np.degrees(np.arctan(2.2) - np.arctan(0.2)))


def test_the_corner_is_the_farthest_one():
    assert corner_angle(model("SIMPLE_PINHOLE", 500.0, 500.0, 400.0)) == pytest.approx(np.arctan(np.hypot(1.0, 0.8)))
    assert corner_angle(model("SIMPLE_FISHEYE", 500.0, 0.0, 0.0)) == pytest.approx(np.hypot(2.0, 1.6))


def test_deviations_of_focal_and_k1_add_up():
    camera = Calibration(camera_matrix(500.0, 500.0, 500.0, 400.0), *SIZE, "x", True, spread={"fx": 5.0, "k1": 0.01})
    theta = np.array([np.pi / 4])

    assert radius_deviation_px(theta, camera) == pytest.approx([np.hypot(5.0, 5.0)])
    assert radius_deviation_px(theta, model("SIMPLE_PINHOLE", 500.0, 500.0, 400.0)) == pytest.approx([0.0])
