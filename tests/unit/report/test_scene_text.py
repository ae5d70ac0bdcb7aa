from pathlib import Path

import numpy as np

from sfm_app.report.text import scene_lines, scene_summary
from sfm_app.types import CameraModel, Scene

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


def told(**counts):
    scene = Scene(Path("sparse"), PLACED, {"x.jpg": "shares no scene"}, {"one": CAMERA}, 1234, 5000, 0.321)
    return "\n".join(scene_lines(scene, COUNTS | counts)), scene_summary(scene, COUNTS | counts)


def test_people_read_how_many_photos_are_placed_how_and_how_sure_the_camera_is():
    text, summary = told()

    assert "5 of 6 photos placed, 1234 points, mean reprojection error 0.321 px" in text
    assert "mapped all at once: it explains more\n" in text
    assert "pairs of photos left out because they do not fit the others: 4" in text
    assert "not placed: x.jpg: shares no scene" in text
    assert "fx 900.0 +- 1.2" in text and "fy 901.0  cx" in text
    assert "upright by vanishing lines, to about 0.3 degrees\n" in text and "unit of its own" not in text
    assert "beware" not in text and "another model" not in text
    assert summary["mapper"] == "global" and summary["cameras"]["one"]["K"][0][0] == 900.0


def test_parts_and_their_wrong_joins_are_told():
    text, _ = told(mapper="parts", parts=[{"dropped_joins": [{}, {}]}, {"dropped_joins": []}])

    assert "mapped in parts that were joined: it explains more\n" in text
    assert text.count("joins between parts left out because other joins or matches contradict them: 2") == 1
    assert "joins between parts" not in told(parts=[{"dropped_joins": []}])[0]


def test_other_models_and_cuts_are_named():
    text, summary = told(
        other_models=[[f"b{n}.jpg" for n in range(6)], ["c.jpg", "d.jpg", "e.jpg"]], cut_apart=["a, b"]
    )

    assert "another model of 6 photos in other_models/1: b0.jpg, b1.jpg, b2.jpg, b3.jpg and 2 more" in text
    assert "another model of 3 photos in other_models/2: c.jpg, d.jpg, e.jpg\n" in text
    assert "split, because more matches contradict the connection than support it: a, b" in text
    assert len(summary["other_models"][0]) == 6
    assert "not placed: x.jpg" in text
    assert "not placed: x.jpg" not in told(other_models=[["x.jpg"]])[0], "said once is enough"


def test_a_model_that_many_matches_contradict_comes_with_a_warning():
    text, _ = told(contradicted_matches=300)

    assert "beware: 25 % of the matches between these photos contradict it" in text


def test_what_finer_features_brought_is_said():
    found = {"photos": ["x.jpg", "y.jpg"], "pairs": 9, "placed": [3, 5], "taken": True}

    text, summary = told(second_look=found)
    assert "finer features were sought in 2 unplaced photos: 5 photos placed instead of 3\n" in text
    assert summary["second_look"]["pairs"] == 9
    failed = told(second_look={"photos": ["x.jpg"], "pairs": 9, "placed": [5], "taken": False, "failed": "no room"})[0]
    assert "in 1 unplaced photos: no more photos placed (it failed: no room)\n" in failed
    assert "finer" not in told()[0]


def test_meters_are_named():
    text, _ = told(orientation=COUNTS["orientation"] | {"unit": "meter"})

    assert "in meters by GPS" in text


def test_a_model_that_may_stand_the_wrong_way_up_comes_with_a_remedy():
    unsure = COUNTS["orientation"] | {"up_sign_odds": 2.3, "up_axis_odds": 900.0, "photos_turned_deg": 270}

    assert "beware: it may stand upside down (odds 2.3 to 1 against)" in told(orientation=unsure)[0]
    assert "run it again with --set scene.photo_rotation_deg=90" in told(orientation=unsure)[0]
    lying = told(orientation=unsure | {"up_sign_odds": 70.0, "up_axis_odds": 1.5, "photos_turned_deg": 0})[0]
    assert "upside down" not in lying and "lie on its side" in lying and "scene.photo_rotation_deg=90 or 270" in lying
    assert "beware" not in told(orientation=unsure | {"up_sign_odds": 70.0})[0]


def test_what_the_last_adjustment_could_not_do_is_said():
    text, summary = told(
        adjustment={"failed": "only 3 of 900 points remain", "failed_in_other_models": {"2": "no"}, "cameras_held": ["one"]}
    )

    assert "beware: the last adjustment failed (only 3 of 900 points remain); cameras and poses are as mapping left" in text
    assert "the last adjustment of other_models/2 failed (no)" in text
    assert "do not determine camera one; it stayed" in text
    assert summary["adjustment"]["cameras_held"] == ["one"]
    assert "beware" not in told(adjustment={"points_left_open": 3})[0]


def test_a_model_that_could_not_be_turned_upright_says_so():
    text, _ = told(orientation={"failed": "it has no points", "unit": "that of mapping", "gps": "not used"})

    assert "frame as left by mapping, neither upright nor in meters: it has no points" in text
    unsure, _ = told(orientation=COUNTS["orientation"] | {"up_deviation_deg": None})
    assert "upright by vanishing lines, with unknown accuracy" in unsure


def test_look_alikes_are_named_and_so_is_what_may_be():
    first, last = ["a.jpg", "b.jpg"], [f"z{n}.jpg" for n in range(5)]
    join = {"pairs": 12, "between": [first, last], "missing": 0.374}

    text, summary = told(look_alikes=[join])
    assert (
        "look-alikes separated, 12 pairs of photos: a.jpg, b.jpg | z0.jpg, z1.jpg, z2.jpg, z3.jpg and 1 more (37 %"
        in text
    )
    assert "beware" not in text and summary["look_alikes"] == [join]

    text, _ = told(perhaps_look_alikes=[join])
    assert (
        "beware: a loop, or look-alikes: 12 pairs take a.jpg, b.jpg and z0.jpg, z1.jpg, z2.jpg, z3.jpg and 1 more for"
        in text
    )

    text, summary = told(weakly_joined=[["a.jpg"], ["b.jpg", "c.jpg"]])
    assert "beware: hardly any point determines how far a.jpg is from the rest" in text
    assert "b.jpg, c.jpg are from" in text
    assert summary["weakly_joined"] == [["a.jpg"], ["b.jpg", "c.jpg"]]

    text, _ = told(jumps=[["a.jpg", "b.jpg"]])
    assert "beware: a jump from a.jpg to b.jpg, which are consecutive" in text


def test_a_camera_for_each_photo_is_named_where_it_was_tried():
    assert "each has its own (a zoom, or several devices)" in told(one_camera_each="taken")[0]
    assert "does not explain them, two do" in told(one_camera_each="two")[0]
    assert "was tried, too, and explains no more" in told(one_camera_each="left")[0]
    assert "each" not in told(one_camera_each="")[0]


def test_a_compensated_shutter_is_named_with_its_deviation():
    shutter = {"readout_ms": 20.94, "deviation_ms": 1.6, "interval_ms": 33.3, "compensated": True}
    text, summary = told(shutter=shutter)

    assert "rolling shutter: rows are read within 20.9 +- 1.6 ms, at 33 ms per frame; poses are those" in text
    assert summary["shutter"] == shutter


def test_why_a_shutter_is_not_compensated_is_said():
    found = {"readout_ms": -0.12, "deviation_ms": 0.31, "interval_ms": 33.3, "compensated": False}
    text, _ = told(shutter=found | {"because": "none is seen"})

    assert "rolling shutter: none is seen (-0.1 +- 0.3 ms), so nothing is compensated\n" in text
    assert "rows" not in text
    assert "shutter" not in told()[0]


def test_why_a_shutter_is_not_measured_is_said():
    text, summary = told(shutter={"compensated": False, "because": "nobody has the time"})

    assert "rolling shutter: nobody has the time, so nothing is compensated\n" in text
    assert summary["shutter"]["because"] == "nobody has the time"
