import json

import numpy as np
import pytest

from benchmarks.cameras.bars import lower_bound, upper_bound, verdict
from benchmarks.cameras.report import DEVIATIONS, medians, page
from benchmarks.cameras.score import Model, TruePhoto, accuracy, camera_errors, stated_deviations, true_photos
from benchmarks.common.metrics import (
    CAP_PX,
    LOST_DEG,
    area_under_recall,
    fundamental_pose_error_deg,
    mean_sampson_px,
    misplaced_photos,
    pose_errors_deg,
    position_rms_percent,
    summary_px,
)
from benchmarks.common.photo_sets import steps
from benchmarks.common.timing import take_turns
from sfm_app.camera.models import camera_matrix
from sfm_app.geometry.epipolar import fundamental_from_pose
from sfm_app.synthetic.cameras import axis_rotation
from sfm_app.synthetic.correspondences import PairOptions, make_pair

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


@pytest.mark.parametrize(
    ("change", "is_wrong"),
    [
        (pose((2, 0, 0), 19.0), False),
        (pose((2, 0, 0), 21.0), True),
        (pose((2, 0, 0.3)), False),
        (pose((2, 0, 0.5)), True),
    ],
)
def test_a_photo_far_off_is_misplaced_and_does_not_drag_others_along(change, is_wrong):
    found = moved({**POSES, "a": change}, 0.3, TURN, np.array([4.0, -7.0, 1.0]))
    assert misplaced_photos(found, POSES, 4.0) == ["a"] * is_wrong


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
    found = {name: camera_matrix(1004.0, 1010.0, 401.0, 300.0) for name in "ab"}
    found["c"] = camera_matrix(1050, 1060, 400, 300)
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


def test_bars_are_met_up_to_the_bound_and_misses_are_named():
    bars = (lower_bound("AUC@1", 0.8), upper_bound("rms", 0.1), upper_bound("px", "incremental"))
    others = {"incremental": {"px": 0.4}}
    assert verdict({"AUC@1": 0.8, "rms": 0.1, "px": 0.4}, others, bars) == "yes"
    missed = verdict({"AUC@1": 0.7, "rms": 0.1, "px": 0.41}, others, bars)
    assert missed == "no: AUC@1 0.7, at least 0.8; px 0.41, at most 0.4"
    missed = verdict({"AUC@1": 0.8, "rms": None, "px": 0.1}, {}, bars)
    assert missed == "no: rms not measured; px has no incremental beside it"
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


CAMERAS = (camera_matrix(700, 720, 250, 260), camera_matrix(900, 900, 300, 200))
T = np.array([0.6, 0.0, -0.8])
R = axis_rotation(np.array([0.0, 0.8, 0.6]), 20.0)


@pytest.mark.parametrize("sign", [1, -1])
def test_the_true_matrix_has_no_pose_error(sign):
    F = sign * 3.7 * fundamental_from_pose(*CAMERAS, R, T)
    assert fundamental_pose_error_deg(F, CAMERAS, R, T) < 1e-5
    assert fundamental_pose_error_deg(F, CAMERAS, R, -5 * T) < 1e-5, "neither sign nor length of t is in F"


@pytest.mark.parametrize("off_deg", [1.0, 7.0])
def test_the_pose_error_is_the_larger_of_rotation_and_translation(off_deg):
    turned = axis_rotation(T, off_deg) @ R
    moved = axis_rotation(np.array([0.0, 1.0, 0.0]), 2 * off_deg) @ T
    F = fundamental_from_pose(*CAMERAS, turned, T)
    assert fundamental_pose_error_deg(F, CAMERAS, R, T) == pytest.approx(off_deg)
    both = fundamental_from_pose(*CAMERAS, turned, moved)
    assert fundamental_pose_error_deg(both, CAMERAS, R, T) == pytest.approx(2 * off_deg)


def test_no_matrix_is_lost():
    assert fundamental_pose_error_deg(None, CAMERAS, R, T) == LOST_DEG
    assert mean_sampson_px(None, np.zeros((1, 2)), np.zeros((1, 2))) == np.inf


@pytest.mark.parametrize(
    ("errors", "area"),
    [([0.0, 0.0], 1.0), ([180.0] * 3, 0.0), ([5.0], 0.75), ([5.0, 180.0], 0.375), ([2.0, 6.0], 0.75)],
)
def test_area_under_recall(errors, area):
    # recall rises linearly from error to error
    assert area_under_recall(np.array(errors), 10) == pytest.approx(area)


def test_failures_are_counted_and_capped():
    found = summary_px(np.array([0.1, 0.3, 80.0, np.inf]))
    assert found == {"mean px": 0.2, "capped mean px": (0.4 + 2 * CAP_PX) / 4, "failures": 2}
    assert summary_px(np.array([np.inf]))["mean px"] == CAP_PX


def test_methods_take_turns_after_a_warm_up_and_bad_matrices_are_no_answer():
    calls = []
    answers = {"good": np.eye(3), "nan": np.full((3, 3), np.nan), "stack": np.ones((9, 3)), "none": None}

    def named(name):
        return lambda *arguments: calls.append((name, arguments[2])) or (answers[name], 7)

    pairs = [make_pair(PairOptions(points=8), seed) for seed in range(2)]
    attempts = take_turns({name: named(name) for name in answers}, pairs, seed=40)

    assert calls == [(name, seed) for seed in (40, 40, 41) for name in answers]
    assert [[attempt.F is None for attempt in tries] for tries in attempts.values()] == [[False] * 2] + [[True] * 2] * 3
