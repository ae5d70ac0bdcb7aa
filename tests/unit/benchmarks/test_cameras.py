import json

import numpy as np
import pytest

from benchmarks.cameras.bars import BARS, lower_bound, upper_bound, verdict
from benchmarks.cameras.methods import methods, rotate_methods
from benchmarks.cameras.report import DEVIATIONS, compare_bytes, medians, page
from benchmarks.cameras.score import Model, TruePhoto, accuracy, camera_errors, stated_deviations, times, true_photos
from benchmarks.common.metrics import area_under_recall, pose_errors_deg, position_rms_percent
from benchmarks.common.photo_sets import steps
from sfm_app.camera.models import camera_matrix
from sfm_app.synthetic.cameras import axis_rotation

K = camera_matrix(1000.0, 1010.0, 400.0, 300.0)
TURN = axis_rotation(np.array([0.6, 0.0, 0.8]), 50.0)


def pose(center, angle_deg=0.0):
    R = axis_rotation(np.array([0.0, 1.0, 0.0]), angle_deg)
    return np.column_stack([R, -R @ np.asarray(center, float)])


def moved(poses, scale, R, t):
    """The same cameras in a world that x -> scale R x + t has changed."""
    found = {}
    for name, P in poses.items():
        center = scale * R @ (-P[:, :3].T @ P[:, 3]) + t
        rotation = P[:, :3] @ R.T
        found[name] = np.column_stack([rotation, -rotation @ center])
    return found


CORNERS = {"a": (2, 0, 0), "b": (-2, 0, 0), "c": (0, 2, 0), "d": (0, -2, 0)}
POSES = {name: pose(center, 10.0 * n) for n, (name, center) in enumerate(CORNERS.items())}


def test_a_similarity_changes_no_score():
    found = moved(POSES, 3.5, TURN, np.array([4.0, -7.0, 1.0]))

    assert position_rms_percent(found, POSES) == pytest.approx(0.0, abs=1e-10)
    assert np.all(pose_errors_deg(found, POSES) < 1e-5)


def test_a_mirrored_world_is_no_similarity():
    mirrored = {name: pose((x, y, 0.5 * x * y + z)) for name, (x, y, z) in {**CORNERS, "e": (1, 2, 1)}.items()}
    world = {name: pose((-x, y, 0.5 * x * y + z)) for name, (x, y, z) in {**CORNERS, "e": (1, 2, 1)}.items()}

    assert position_rms_percent(mirrored, world) > 5


def test_rms_is_counted_in_mean_distances_from_the_mean():
    # up and down in turn is what no similarity of a square takes back, but for a little by shrinking it
    up = {"a": 0.1, "b": 0.1, "c": -0.1, "d": -0.1}
    lifted = {name: pose((x, y, up[name])) for name, (x, y, _) in CORNERS.items()}

    assert position_rms_percent(lifted, POSES) == pytest.approx(100 * np.sqrt(0.01 / 4.01))
    assert position_rms_percent({name: POSES[name] for name in "ab"}, POSES) is None


def test_a_photo_left_out_costs_all_its_pairs():
    found = {name: POSES[name] for name in "abc"}
    errors = pose_errors_deg(found, POSES)

    assert sorted(errors.round(4).tolist()) == [0.0] * 3 + [180.0] * 3
    assert area_under_recall(errors, 1) == pytest.approx(0.5, abs=1e-4)
    row = accuracy([Model(found, dict.fromkeys(found, K), 5, 9, 0.3)], truth(), 4)
    assert (row["registered"], row["of"], row["unregistered"], row["AUC@10"]) == (3, 4, 1, 0.5)


def truth():
    return {name: TruePhoto(K, P, 800) for name, P in POSES.items()}


def test_every_photo_is_compared_with_its_own_camera():
    far = {"a": K, "b": camera_matrix(2000.0, 2020.0, 500.0, 300.0)}
    known = {name: TruePhoto(true, POSES[name], 800) for name, true in far.items()}

    row = camera_errors({"a": K, "b": K, "nobody": K}, known)

    assert (row["e_focal %"], row["e_OC %"], row["e_OC_w %"]) == (25.0, 5.0, 6.25)


def test_nothing_found_scores_nothing():
    row = accuracy([], truth(), 4)

    assert (row["registered"], row["models"], row["AUC@5"], row["e_focal %"], row["center rms %"]) == (
        0,
        0,
        0,
        None,
        None,
    )
    assert accuracy([], {}, 7)["of"] == 7


def test_each_of_several_models_is_judged_by_its_own_photos():
    halves = [Model({name: POSES[name] for name in pair}, {}, 1, 1, 0.1) for pair in ("ab", "cd")]

    row = accuracy(halves, truth(), 4)

    assert row["models"] == 2
    assert row["AUC@5 of each model"] == "1.00, 1.00"
    assert row["AUC@5"] == pytest.approx(1 / 6, abs=1e-4)


def test_truth_changes_with_the_photos(tmp_path):
    entry = {"file": "a.jpg", "width": 800, "height": 600, "K": K.tolist(), "R": np.eye(3).tolist(), "t": [1, 2, 3]}
    (tmp_path / "cameras.json").write_text(json.dumps({"images": [entry]}))

    photo = true_photos(tmp_path / "cameras.json", steps("window:100,50,512,512+scale:2,1"))["a"]

    assert photo.K.tolist() == [[2000, 0, 600], [0, 1010, 250], [0, 0, 1]]
    assert photo.width == 800
    assert true_photos(tmp_path / "missing.json", []) == {}


def left_behind(folder, deviations):
    cameras = {"wide": {"identifiable": True, "K": K.tolist()}, "long": {"identifiable": False, "K": K.tolist()}}
    camera_of = {"a.png": "wide", "b.png": "wide", "c.png": "long"}
    refined = {name: {"deviations": values} for name, values in deviations.items()}
    (folder / "calibration.json").write_text(json.dumps({"cameras": cameras, "camera_of": camera_of}))
    (folder / "scene.json").write_text(json.dumps({"cameras": refined, "camera_of": camera_of}))
    found = {name: camera_matrix(1004.0, 1010.0, 401.0, 300.0) for name in "ab"} | {
        "c": camera_matrix(1050, 1060, 400, 300)
    }
    return Model({name: POSES[name] for name in "abc"}, found, 1, 1, 0.1)


def test_errors_are_counted_in_the_deviations_of_the_camera_that_took_the_photo(tmp_path):
    model = left_behind(tmp_path, {"wide": {"fx": 2.0, "fy": 3.0, "cx": 0.25}})

    row = stated_deviations(tmp_path, model, truth())

    assert (row["fx in sd"], row["fy in sd"], row["cx in sd"], row["worst in sd"]) == (2.0, 0.0, 4.0, 4.0)
    assert "cy in sd" not in row and row["sd cx px"] == 0.25


def test_of_several_cameras_the_worst_deviation_counts(tmp_path):
    model = left_behind(tmp_path, {"wide": {"f": 4.0}, "long": {"f": 10.0, "k1": 0.1}})

    assert stated_deviations(tmp_path, model, truth()) == {"sd f px": 10.0, "f in sd": 5.0, "worst in sd": 5.0}
    assert stated_deviations(tmp_path, left_behind(tmp_path, {}), truth()) == {"worst in sd": None}


def test_steps_of_both_sides_meet_in_the_same_columns():
    ours = times({"match_graph": 5.0, "view_graph": 1.0, "scene": 2.0}, complete=True)
    stock = times({"features": 3.0, "match_and_verify": 2.5, "map": 1.0}, complete=True)

    assert (ours["features + matches"], ours["view graph"], ours["map + BA"], ours["total"]) == (5.0, 1.0, 2.0, 8.0)
    assert (stock["features + matches"], stock["map + BA"], stock["total"]) == (5.5, 1.0, 6.5)
    assert times({"match_graph": 5.0}, complete=False)["total"] is None


def test_methods_take_turns_and_other_settings_are_methods():
    these = methods({"scene.max_init_pairs=2": {"scene": {"max_init_pairs": 2}}})

    assert [method.name for method in these] == ["sfm-app", "sfm-app, scene.max_init_pairs=2", "incremental", "global"]
    assert rotate_methods(these, 6)[0].name == "incremental"
    assert [method.kind for method in methods({}, ours_only=True)] == ["sfm-app"]


def test_bars_are_met_up_to_the_bound_and_misses_are_named():
    bars = (lower_bound("AUC@1", 0.8), upper_bound("rms", 0.1), upper_bound("px", "incremental"))
    others = {"incremental": {"px": 0.4}}

    assert verdict({"AUC@1": 0.8, "rms": 0.1, "px": 0.4}, others, bars) == "yes"
    assert verdict({"AUC@1": 0.7, "rms": 0.1, "px": 0.41}, others, bars) == (
        "no: AUC@1 0.7, at least 0.8; px 0.41, at most 0.4"
    )
    assert verdict({"AUC@1": 0.8, "rms": None, "px": 0.1}, {}, bars) == (
        "no: rms not measured; px has no incremental beside it"
    )
    assert verdict({}, {}, ()) == ""


def runs(method, totals, **figures):
    shared = {"photos": "merton1", "method": method, "failed": "", "registered": 3, "of": 3}
    return [shared | {"repetition": n, "total": total} | figures for n, total in enumerate(totals)]


def test_ratios_are_taken_within_a_repetition_and_the_median_counts():
    rows = medians([*runs("incremental", (10.0, 20.0, 10.0)), *runs("sfm-app", (9.0, 10.0, 30.0), **{"AUC@5": 0.9})])
    ours = next(row for row in rows if row["method"] == "sfm-app")

    assert (ours["/ incremental"], ours["total"], ours["fastest"], ours["slowest"]) == (0.9, 10.0, 9.0, 30.0)
    assert (ours["repetitions"], ours["placed"], ours["bar met"]) == (3, "3/3", "yes")
    assert [row["bar met"] for row in rows if row["method"] == "incremental"] == [""]
    assert "| merton1 | sfm-app | 3/3 |" in page("", rows) and "in 3 sd" in DEVIATIONS


def test_a_run_that_failed_has_no_time():
    failed, done = medians([*runs("sfm-app", (None,)), *runs("incremental", (10.0,))])

    assert (failed["total"], failed["/ incremental"], done["/ incremental"]) == (None, None, 1.0)


def test_equal_bytes_are_told_from_unequal_ones():
    first, second = {"cameras.bin": "1", "images.bin": "2"}, {"cameras.bin": "1", "images.bin": "3"}

    assert compare_bytes([first, first]) == "yes"
    assert compare_bytes([first, second]) == "no: images.bin"
    assert compare_bytes([first]) is None


def test_bars_stand_on_sets_and_columns_that_there_are():
    measured = accuracy([Model(POSES, dict.fromkeys(POSES, K), 5, 9, 0.3)], truth(), 4)
    known = {*measured, "worst in sd", "/ incremental"}

    assert all(bar.column in known for bars in BARS.values() for bar in bars)
    assert {kind for title in BARS for kind, _ in steps(title.partition(" ")[2])} == {"crop", "scale", "window"}
