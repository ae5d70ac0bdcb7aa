"""The last adjustment of cameras that the user gave, or whose model he chose."""

import numpy as np
import pytest

from sfm_app.bundle.lens_parts import CameraRule
from sfm_app.camera.models import calibration_from_model
from sfm_app.camera.projection import FISHEYE, FX, K1, K2, K3, P1
from sfm_app.colmap.bundle import adjust, camera_family, read_camera
from sfm_app.estimation.given_cameras import find_contradictions
from sfm_app.types.camera import KEPT

SIZE = (1000, 800)
TRUE = [900.0, 900.0, 500.0, 400.0, -0.1, 0.02, 0.0, 0.0]


def given(params, model="OPENCV", *, keep):
    camera = calibration_from_model(model, params, SIZE)
    return CameraRule(given=type(camera)(**{name: getattr(camera, name) for name in camera.__slots__} | (
        {"method": KEPT} if keep else {}
    )))  # fmt: skip


@pytest.mark.slow
def test_a_kept_camera_stays_to_the_last_bit_and_its_photos_say_whether_it_is_right(mapped):
    model, database = mapped(TRUE, start=(893.0, 503.0, 396.0, 0.0))
    rule = given(TRUE, keep=True)

    found = adjust(model, database, {1: rule})

    camera = found.model.cameras[1]
    assert camera.model.name == "OPENCV" and camera.params.tolist() == TRUE
    assert 0.25 < found.model.compute_mean_reprojection_error() < 0.5
    assert found.deviations[1] == {} and found.determined[1] == () and found.held == ()
    assert found.estimates[1].focal_px == pytest.approx(900.0, rel=0.005)
    assert find_contradictions(rule.given, found.estimates[1]) == []


@pytest.mark.slow
def test_a_wrong_camera_is_kept_and_contradicted(mapped):
    wrong = [970.0, 970.0, *TRUE[2:]]
    model, database = mapped(TRUE, start=(893.0, 503.0, 396.0, 0.0))
    rule = given(wrong, keep=True)

    found = adjust(model, database, {1: rule})

    assert found.model.cameras[1].params.tolist() == wrong
    [said] = [one for one in find_contradictions(rule.given, found.estimates[1]) if one.what == "focal length"]
    assert (said.given_px, 890 < said.found_px < 950) == (970.0, True)


@pytest.mark.slow
def test_a_given_camera_is_refined_and_contradicted_where_it_is_wrong(mapped):
    wrong = [970.0, 970.0, *TRUE[2:]]
    model, database = mapped(TRUE, start=(893.0, 503.0, 396.0, 0.0))
    rule = given(wrong, keep=False)

    found = adjust(model, database, {1: rule})

    assert found.model.cameras[1].params[:2] == pytest.approx([900.0, 900.0], rel=0.005)
    [said] = find_contradictions(rule.given, found.estimates[1])
    assert said.what == "focal length" and said.found_px == pytest.approx(900.0, rel=0.005)


@pytest.mark.slow
def test_what_photos_do_not_determine_stays_as_it_was_given(mapped):
    """A rational term that no other camera has, and which a narrow view does not show."""
    true = [4500.0, 4500.0, 500.0, 400.0, -0.1, 0.02, 0.0, 0.0, 0.5, 0.0, 0.0, 0.0]
    model, database = mapped([*true[:4], 0, 0, 0, 0], start=(4480.0, 500.0, 400.0, 0.0))

    plain = read_camera(adjust(model, database).model.cameras[1])
    found = read_camera(adjust(model, database, {1: given(true, "FULL_OPENCV", keep=False)}).model.cameras[1])

    assert (plain[K3], found[K3]) == (0.0, 0.5)
    assert abs(plain[K2]) < 0.01 < 0.015 < found[K2] < 0.025


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "free"),
    [
        ("SIMPLE_PINHOLE", ()),
        ("PINHOLE", ("aspect",)),
        ("SIMPLE_RADIAL", ("k1",)),
        ("RADIAL", ("k1", "k2")),
        ("OPENCV", ("aspect", "k1", "k2", "p1 p2")),
    ],
)
def test_the_model_that_the_user_names_is_the_one_that_is_fitted(mapped, name, free):
    model, database = mapped([900.0, 903.0, *TRUE[2:6], 0.004, -0.004], start=(893.0, 500.0, 400.0, -0.08))

    found = adjust(model, database, {1: CameraRule(model=name)})

    chosen, params = found.lenses[1].chosen, read_camera(found.model.cameras[1])
    assert chosen.model == name and set(chosen.free) - {"center"} == set(free)
    assert (params[K1] != 0.0, params[K2] != 0.0, params[P1] != 0.0) == ("k1" in free, "k2" in free, "p1 p2" in free)
    assert (params[FX] != params[FX + 1]) == ("aspect" in free)
    assert params[FX] == pytest.approx(900.0, rel=0.06 if "k1" not in free else 0.006)


@pytest.mark.slow
def test_a_perspective_lens_becomes_the_fisheye_that_the_user_names(mapped):
    model, database = mapped(TRUE, start=(893.0, 500.0, 400.0, -0.08))

    found = adjust(model, database, {1: CameraRule(model="RADIAL_FISHEYE")})

    camera = found.model.cameras[1]
    assert camera.model.name == "OPENCV_FISHEYE" and camera_family(camera) == FISHEYE
    assert found.lenses[1].chosen.model == "RADIAL_FISHEYE"
    assert 0.25 < found.model.compute_mean_reprojection_error() < 0.6
    assert camera.params[0] == pytest.approx(900.0, rel=0.01)
    assert np.count_nonzero(camera.params[6:]) == 0
