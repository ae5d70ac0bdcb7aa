"""The benchmark of lenses measures what it says, and finds the right model in a few bundles."""

import numpy as np
import pytest

from benchmarks.lenses.command import methods_for, page
from benchmarks.lenses.models import measure
from benchmarks.lenses.radius import projection_of, radius_error_percent
from sfm_app.synthetic.cameras import Lens, make_camera, make_wide_camera
from sfm_app.synthetic.photo_folder import Truth
from sfm_app.types import Calibration


def calibration(camera, focal=1.0):
    K = camera.K.copy()
    K[[0, 1], [0, 1]] *= focal
    return Calibration(K, camera.width, camera.height, "zero-curves", True, distortion=(camera.radial,))


def error(true, found, reach_px=1e9):
    return radius_error_percent(true, projection_of(found), found.K[:2, 2], reach_px)


def test_the_true_camera_has_no_error():
    camera = make_camera(320, 240, radial=-0.15)
    assert error(camera, calibration(camera)) < 1e-9


def test_a_wrong_focal_moves_the_corner():
    camera = make_camera(320, 240, center=(0.5, 0.5))
    corner = np.hypot(159.5, 119.5)
    assert error(camera, calibration(camera, 1.02)) == pytest.approx(2.0 * corner / 320, rel=0.02)
    assert error(camera, calibration(camera, 1.02), reach_px=50.0) == pytest.approx(2.0 * 50 / 320, rel=0.1)


def test_a_pinhole_cannot_show_what_a_fisheye_sees_behind():
    camera = make_wide_camera(320, 240, 200.0, Lens("equidistant"), center=(0.5, 0.5))
    assert error(camera, calibration(camera)) == 100.0


def test_stock_is_told_the_lens_of_the_folder():
    camera = make_wide_camera(320, 240, 120.0, Lens("equidistant"))
    truth = Truth({"a.jpg": camera}, {"a.jpg": np.eye(3, 4)}, np.zeros((3, 3)), np.array([[0, 1, 2]]))
    told = methods_for(truth)[-1].settings["camera_params"]
    assert [float(value) for value in told.split(",")][:2] == [camera.K[0, 0]] * 2
    assert "equidistant" in page([{"method": "sfm-app", "projection": "equidistant"}])


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 2])
def test_the_model_of_a_perspective_lens_is_found(seed):
    row = measure("plain", seed, hold_out=False)
    assert row["right"] == 1 and row["needless"] == 0 and row["file"] == "OPENCV"
    assert 0.0 < row["focal %"] < 0.1 and row["lost"] > 0.0


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 8])
def test_a_fisheye_stays_one_and_its_radius_is_accurate(seed):
    row = measure("fisheye", seed, hold_out=False)
    assert row["file"] == "OPENCV_FISHEYE" and "prism" not in row["free"]
    assert 0.0 < row["radius %"] < 0.1
