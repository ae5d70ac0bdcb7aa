"""Results in sentences."""

from dataclasses import replace
from pathlib import Path
from typing import get_args

import numpy as np
import pytest

from sfm_app.camera.bearings import field_of_view_deg
from sfm_app.camera.models import camera_matrix
from sfm_app.frame.volumes import Volume
from sfm_app.report.text import (
    camera_texts,
    field_text,
    held_text,
    lens_text,
    result_lines,
    scale_lines,
    scene_lines,
    scene_summary,
    volume_lines,
)
from sfm_app.settings import HYPOTHESES, HypothesisName
from sfm_app.types import Calibration, CameraModel, Scene


def camera(fx=500.0, fy=500.0, cx=500.0, cy=400.0, **values):
    values = {"method": "zero-curves", "identifiable": True} | values
    return Calibration(camera_matrix(fx, fy, cx, cy), 1000, 800, **values)


def test_the_field_of_view_counts_from_the_optical_center():
    across, down = field_of_view_deg(camera(cx=0.0))
    assert across == pytest.approx(np.degrees(np.arctan(2.0)))
    assert down == pytest.approx(2 * np.degrees(np.arctan(0.8)))


def test_a_camera_says_its_parameters_with_deviations_and_its_field():
    assert list(camera_texts(camera(spread={"fx": 2.4}))) == [
        "fx 500.0 +- 2.4  fy 500.0  cx 500.0  cy 400.0 px",
        "sees 90 degrees from left to right, 77 from top to bottom",
    ]


def test_wide_lenses_say_what_they_see():
    wide = camera(fx=400.0, fy=400.0, projection="fisheye", distortion=(0.0,))
    narrow = camera(fx=900.0, fy=900.0, projection="fisheye", distortion=(0.0,))

    assert field_text(wide) == "a fisheye that sees 143 degrees from left to right, 115 from top to bottom"
    assert field_text(narrow) == "sees 64 degrees from left to right, 51 from top to bottom"
    assert list(camera_texts(camera(projection="equirectangular"))) == ["360-degree panoramas, 1000 x 800 px"]
    assert "as given, to be refined" in camera_texts(camera(method="given"))


def test_distortion_widens_the_field():
    assert "sees 98 degrees" in field_text(camera(distortion=(-0.1,)))


def test_a_guess_says_what_it_is_and_why():
    texts = camera_texts(camera(identifiable=False, method="claim", reason="an orbit"))
    assert "these photos do not determine it (an orbit): a claim" in texts


def test_lens_and_assumptions_are_empty_without_content():
    plain, bent = camera(), camera(distortion=(-0.12,), spread={"k1": 0.004}, held=("center", "aspect"))
    assert (lens_text(plain), held_text(plain)) == ("", "")
    assert lens_text(bent) == "The lens bends lines outwards (barrel), k1 -0.120 +- 0.004."
    assert held_text(bent).endswith("optical center near the middle of the photo, square pixels.")
    assert held_text(camera(held=("center",), identifiable=False)) == ""
    assert lens_text(camera(distortion=(-0.003,), held=("k1",))) == ""


def test_a_distortion_within_its_deviation_has_no_direction():
    assert (
        lens_text(camera(distortion=(0.002,), spread={"k1": 0.004}))
        == "The lens hardly bends lines, k1 0.002 +- 0.004."
    )
    assert "pincushion" in lens_text(camera(distortion=(0.009,), spread={"k1": 0.004}))


K = np.array([[900.0, 0, 320], [0, 901.0, 240], [0, 0, 1]])
PLACED = {f"{number}.jpg": np.eye(3, 4) for number in range(5)}
CAMERA = CameraModel("OPENCV", (900.0, 901, 320, 240, 0, 0, 0, 0), K, 640, 480, {"fx": 1.25})
COUNTS = {
    "mapper": "global",
    "mapper_reason": "it explains more",
    "pairs_dropped": {"contradicts other pairs": 3, "points behind a camera": 1},
    "explained_matches": 900,
    "contradicted_matches": 20,
    "orientation": {"up": "vanishing lines", "up_deviation_deg": 0.31, "unit": "about the size of the scene"},
}


def describe(*, cameras=(CAMERA,), **counts):
    named = {str(number): camera for number, camera in enumerate(cameras)}
    camera_of = {name: str(number % len(cameras)) for number, name in enumerate(PLACED)}
    scene = Scene(Path("sparse"), PLACED, {"x.jpg": "shares no scene"}, named, 1234, 5000, 0.321, camera_of)
    return "\n".join(scene_lines(scene, COUNTS | counts)), scene_summary(scene, COUNTS | counts)


def test_people_read_how_many_photos_are_placed_how_and_how_sure_the_camera_is():
    text, summary = describe()

    assert "5 of 6 photos placed, 1234 points, mean reprojection error 0.321 px" in text
    assert "mapped globally: it explains more\n" in text
    assert "rejected pairs of photos that contradict the others: 4" in text
    assert "not placed: x.jpg: shares no scene" in text
    assert "fx 900.0 +- 1.2" in text and "fy 901.0  cx" in text
    assert "upright by vanishing lines, to about 0.3 degrees\n" in text and "unit of its own" not in text
    assert "beware" not in text and "another model" not in text
    assert summary["mapper"] == "global" and summary["cameras"]["0"]["K"][0][0] == 900.0


def test_parts_and_their_wrong_joins_are_describe():
    text, _ = describe(mapper="parts", parts=[{"dropped_joins": [{}, {}]}, {"dropped_joins": []}])
    assert "mapped in parts, then joined: it explains more\n" in text
    assert text.count("rejected joins between parts, which other joins or matches contradict: 2") == 1
    assert "joins between parts" not in describe(parts=[{"dropped_joins": []}])[0]


def test_other_models_and_cuts_are_named():
    text, summary = describe(
        other_models=[[f"b{n}.jpg" for n in range(6)], ["c.jpg", "d.jpg", "e.jpg"]], cut_apart=["a, b"]
    )

    assert "another model of 6 photos in other_models/1: b0.jpg, b1.jpg, b2.jpg, b3.jpg and 2 more" in text
    assert "another model of 3 photos in other_models/2: c.jpg, d.jpg, e.jpg\n" in text
    assert "split, because more matches contradict the connection than support it: a, b" in text
    assert len(summary["other_models"][0]) == 6
    assert "not placed: x.jpg" in text
    assert "not placed: x.jpg" not in describe(other_models=[["x.jpg"]])[0], "said once is enough"


def test_a_model_that_many_matches_contradict_comes_with_a_warning():
    text, _ = describe(contradicted_matches=300)
    assert "beware: 25 % of the matches between these photos contradict the model" in text


def trial(name, reason, *, accepted=True, photos=(3, 5), failure=""):
    return {"name": name, "reason": reason, "accepted": accepted, "photos": list(photos), "failure": failure}


def test_the_result_of_finer_features_is_named():
    tried = trial("finer-features", "2 photos are unregistered")
    text, summary = describe(hypotheses=[tried])
    start = "tried finer features for unplaced photos, because 2 photos are unregistered:"
    assert f"{start} 5 photos instead of 3\n" in text
    assert summary["hypotheses"] == [tried]
    failed = tried | {"accepted": False, "photos": [5, 5], "failure": "no room"}
    assert f"{start} it failed: no room\n" in describe(hypotheses=[failed])[0]
    assert f"{start} it is no better\n" in describe(hypotheses=[tried | {"accepted": False}])[0]
    assert "tried" not in describe(hypotheses=[trial("first-pass", "", photos=(0, 5))])[0]


@pytest.mark.parametrize("name", get_args(HypothesisName))
def test_every_hypothesis_has_words(name):
    assert f"tried {HYPOTHESES[name]}, because of a doubt" in describe(hypotheses=[trial(name, "of a doubt")])[0]


def test_meters_are_named():
    text, _ = describe(orientation=COUNTS["orientation"] | {"unit": "meter"})
    assert "in meters by GPS" in text
    swapped = COUNTS["orientation"] | {"gps": "not used: latitude and longitude are probably swapped"}
    assert "beware: GPS is not used: latitude and longitude are probably swapped" in describe(orientation=swapped)[0]


def test_a_model_that_may_stand_the_wrong_way_up_comes_with_a_remedy():
    unsure = COUNTS["orientation"] | {"up_sign_odds": 2.3, "up_axis_odds": 900.0, "photos_turned_deg": 270}
    assert "beware: the model may stand upside down (odds 2.3 to 1 against)" in describe(orientation=unsure)[0]
    lying = describe(orientation=unsure | {"up_sign_odds": 70.0, "up_axis_odds": 1.5, "photos_turned_deg": 0})[0]
    assert "upside down" not in lying and "lie on its side" in lying and "press upright in the 3D view" in lying
    assert "beware" not in describe(orientation=unsure | {"up_sign_odds": 70.0})[0]


def test_who_has_given_a_level_surface_reads_no_doubts_of_the_up_direction():
    unsure = COUNTS | {"orientation": COUNTS["orientation"] | {"up_axis_odds": 1.5, "photos_turned_deg": 0}}
    size = {"unit": "arbitrary", "contradictions": [], "problems": []}
    texts = ["\n".join(result_lines(None, Scene(Path("sparse"), PLACED, {}, {}, 1234, 5000, 0.3), {
        "scene": {"counts": unsure}, "scale": {"counts": size | level}})) for level in ({}, {"level": 1})]  # fmt: skip
    assert "lie on its side" in texts[0] and "level surfaces" not in texts[0]
    assert "lie on its side" not in texts[1] and "upright by the level surfaces" in texts[1]


def test_check_points_outside_of_their_deviations_are_named():
    figures = {"inside": ["CHK-1", "CHK-2"], "outside": [], "plan_rms_m": 0.0123, "height_rms_m": 0.02}
    size = {"unit": "meter", "deviation_percent": 0.1, "source": "x", "contradictions": [], "problems": []}
    _, line = scale_lines(size | {"check_points": figures})
    assert "2 of 2 check points lie inside three of their deviations: off by 1.23 cm in plan and 2 cm in height" in line
    *_, first, second = scale_lines(size | {"check_points": figures | {"outside": ["CHK-3"]}})
    assert "2 of 3 check points" in first and "beware" in second and "CHK-3" in second


def test_volumes_have_deviations_and_name_what_is_missing():
    volume = Volume(4.1, 0.5, 0.11, 0.07, 0.09, 16.0, 0.034, metric=True)
    cut, fill, net, area, missing = volume_lines(volume)
    assert "above the plane (cut)" in cut and "4.1 +- 0.11 m3" in cut
    assert "0.5 +- 0.07 m3" in fill and "3.6 +- 0.09 m3" in net and "16 m2" in area
    assert "3.4 % of the area has no surface" in missing
    *_, unit = volume_lines(replace(volume, missing=0.0, metric=False))
    assert "the model's own unit" in unit and "m3" not in "".join(volume_lines(replace(volume, metric=False)))


def test_a_failed_adjustment_is_named():
    text, summary = describe(
        adjustment={
            "failed": "only 3 of 900 points remain",
            "failed_in_other_models": {"2": "no"},
            "cameras_held": ["one"],
        }
    )

    assert "beware: the last adjustment failed (only 3 of 900 points remain), so places and depths are those of" in text
    assert "the last adjustment of other_models/2 failed (no)" in text
    assert "do not determine camera one; it keeps" in text
    assert summary["adjustment"]["cameras_held"] == ["one"]
    assert "beware" not in describe(adjustment={"points_left_open": 3})[0]


def test_a_model_that_could_not_be_turned_upright_says_so():
    text, _ = describe(orientation={"failed": "it has no points", "unit": "that of mapping", "gps": "not used"})
    assert "the frame is that of mapping, neither upright nor in meters: it has no points" in text
    unsure, _ = describe(orientation=COUNTS["orientation"] | {"up_deviation_deg": None})
    assert "upright by vanishing lines, with unknown accuracy" in unsure


def test_look_alikes_and_possible_look_alikes_are_named():
    first, last = ["a.jpg", "b.jpg"], [f"z{n}.jpg" for n in range(5)]
    join = {"pairs": 12, "between": [first, last], "missing": 0.374}

    text, summary = describe(look_alikes=[join])
    assert (
        "look-alikes separated, 12 pairs of photos: a.jpg, b.jpg | z0.jpg, z1.jpg, z2.jpg, z3.jpg and 1 more (37 %"
        in text
    )
    assert "beware" not in text and summary["look_alikes"] == [join]

    text, _ = describe(perhaps_look_alikes=[join])
    assert (
        "beware: a loop, or look-alikes: 12 pairs match a.jpg, b.jpg with z0.jpg, z1.jpg, z2.jpg, z3.jpg and 1 more,"
        in text
    )

    text, summary = describe(weakly_joined=[["a.jpg"], ["b.jpg", "c.jpg"]])
    assert "beware: few points determine the distance of a.jpg from the rest" in text
    assert "distance of b.jpg, c.jpg from" in text
    assert summary["weakly_joined"] == [["a.jpg"], ["b.jpg", "c.jpg"]]

    text, _ = describe(jumps=[["a.jpg", "b.jpg"]])
    assert "beware: a jump between the consecutive photos a.jpg and b.jpg" in text

    for accepted in (True, False):
        text, _ = describe(hypotheses=[trial("false-joins", "two places", photos=(5, 5), accepted=accepted)])
        assert ("beware: some sides of this place look alike" in text) is accepted


def test_uncertain_focal_lengths_of_most_photos_are_a_warning():
    unsure = replace(CAMERA, deviations={"fx": 9.0, "fy": 90.1})
    text, _ = describe(cameras=[unsure, unsure, CAMERA])
    assert "beware: the focal length is uncertain by 10 %, and depths with it: add photos" in text
    text, _ = describe(cameras=[CAMERA, replace(unsure, deviations={"fx": 90.1}), CAMERA, CAMERA])
    assert "beware: the focal length of 1.jpg is uncertain by 10 %, and depths with it: add photos" in text
    for deviations in ({"fx": 29.0}, {}):
        assert "is uncertain" not in describe(cameras=[replace(unsure, deviations=deviations)])[0]


def test_a_camera_for_each_photo_is_named_where_it_was_tried():
    tried = trial("other-cameras", "a shared camera does not fit", photos=(5, 5))
    start = "other cameras for photos of one size (a zoom, or several devices), because a shared camera does not fit:"
    assert f"{start} it is better\n" in describe(hypotheses=[tried])[0]
    assert f"{start} it is no better\n" in describe(hypotheses=[tried | {"accepted": False}])[0]
    assert "each" not in describe()[0]


def test_a_compensated_shutter_is_named_with_its_deviation():
    shutter = {"readout_ms": 20.94, "deviation_ms": 1.6, "interval_ms": 33.3, "compensated": True}
    text, summary = describe(shutter=shutter)
    assert "rolling shutter: readout 20.9 +- 1.6 ms of 33 ms per frame; poses are of middle" in text
    assert summary["shutter"] == shutter


def test_why_a_shutter_is_not_compensated_is_said():
    result = {"readout_ms": -0.12, "deviation_ms": 0.31, "interval_ms": 33.3, "compensated": False}
    text, _ = describe(shutter=result | {"because": "none is seen"})
    assert "rolling shutter, not compensated: none is seen (-0.1 +- 0.3 ms)\n" in text
    assert "readout" not in text
    assert "shutter" not in describe()[0]


def test_why_a_shutter_is_not_measured_is_said():
    text, summary = describe(shutter={"compensated": False, "because": "nobody has the time"})
    assert "rolling shutter, not compensated: nobody has the time\n" in text
    assert summary["shutter"]["because"] == "nobody has the time"
