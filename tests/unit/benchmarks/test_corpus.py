import argparse
import json
import re
import sys
import time

import numpy as np
import pytest
from PIL import Image

from benchmarks.cameras.methods import methods
from benchmarks.cameras.score import Model, TruePhoto
from benchmarks.common.photo_sets import photo_set, steps, stride
from benchmarks.common.processes import run_command
from benchmarks.corpus import command as corpus
from benchmarks.corpus import kept_runs
from benchmarks.corpus.bars import demands, unreported_fold
from benchmarks.corpus.score import Doubt, claimed_errors, parameter_counts, parameter_errors, walk_figures
from benchmarks.corpus.trajectory import offset_errors, order_scores
from sfm_app.camera.models import camera_matrix
from sfm_app.synthetic.cameras import axis_rotation, look_at
from sfm_app.types.scene import camera_center

K = camera_matrix(1000.0, 1000.0, 400.0, 300.0)
Y = np.array([0.0, 1.0, 0.0])


def pose(center, angle_deg=0.0):
    R = axis_rotation(Y, angle_deg)
    return np.column_stack([R, -R @ np.asarray(center, float)])


def walk(places):
    return {f"{k:03d}": pose((x, 0.1 * np.sin(k), 0.02 * k)) for k, x in enumerate(places)}


def test_a_walk_that_leads_onwards_and_one_that_is_folded():
    onwards, back = order_scores(walk(np.arange(20.0))), order_scores(walk([*range(10), *range(10)]))
    assert onwards.axis == pytest.approx(1.0) and onwards.distance > 0.99 and onwards.jumps == 0
    assert back.axis < 0.6 and back.distance < 0.4 and back.jumps == 1
    assert order_scores(walk([0.0, 1.0])) is None


def test_an_offset_camera_is_fitted_and_what_is_off_remains():
    rng = np.random.default_rng(3)
    ours = {f"{k:03d}": look_at(rng.uniform(-2, 2, 3), rng.uniform(-2, 2, 3), 90.0 * k) for k in range(30)}
    turn, shift = axis_rotation(np.array([1.0, 0.0, 0.0]), 2.5), np.array([0.02, -0.01, 0.03])
    world = axis_rotation(np.array([0.0, 0.0, 1.0]), 40.0)
    beside = {}
    for name, P in ours.items():
        R = turn @ P[:, :3] @ world.T
        center = 1.7 * world @ camera_center(P) + [3.0, -1.0, 0.5] + R.T @ shift
        beside[name] = np.column_stack([R, -R @ center])

    found = offset_errors(ours, beside)
    assert found.center.max() < 1e-3 and found.rotation_deg.max() < 0.05
    assert found.shift == pytest.approx(np.linalg.norm(shift), abs=1e-3)
    assert found.turn_deg == pytest.approx(2.5, abs=0.05)
    assert found.world.scale == pytest.approx(1.7, abs=1e-3)
    assert np.allclose(found.world.R, world, atol=1e-3) and np.allclose(found.world.t, [3.0, -1.0, 0.5], atol=3e-3)

    moved = {name: P + np.column_stack([np.zeros((3, 3)), [0.05 * (k == 4), 0, 0]]) for k, (name, P) in enumerate(
        beside.items())}  # fmt: skip
    assert 0.04 < offset_errors(ours, moved).center.max() < 0.06
    assert offset_errors(dict(list(ours.items())[:3]), beside) is None


def left_behind(folder, before, after):
    told = {"identifiable": before is not None, "K": (K if before is None else before).tolist()}
    cameras = {"a": told | {"spread": {"fx": 10.0, "fy": 10.0}}}
    refined = {"a": {"K": after[0].tolist(), "deviations": after[1], "determined": []}}
    camera_of = {"p.png": "a", "q.png": "a"}
    for name, found in (("calibration", cameras), ("scene", refined)):
        (folder / f"{name}.json").write_text(json.dumps({"cameras": found, "camera_of": camera_of}))
    return {name: TruePhoto(K, pose((0, 0, 0)), 800.0) for name in "pq"}


def test_errors_are_counted_in_what_is_stated(tmp_path):
    before, after = (camera_matrix(1020.0, 1000.0, 408.0, 300.0), camera_matrix(1050.0, 1005.0, 400.0, 302.0))
    truth = left_behind(tmp_path, before, (after, {"fx": 10.0, "fy": 10.0, "cx": 1.0, "cy": 1.0}))

    rows = parameter_errors(tmp_path, truth, Doubt(2.0, 0.5))

    fx, _, cx, _ = (row for row in rows if row["when"] == "before")
    assert (fx["error %"], fx["in sd"], fx["identifiable"], fx["its photos"]) == (2.0, 2.0, "yes", 2)
    assert (cx["error %"], cx["sd"], cx["in sd"]) == (1.0, None, None)
    far = next(row for row in rows if row["when"] == "after" and row["parameter"] == "fx")
    assert (far["error %"], far["in sd"]) == (5.0, 5.0)
    assert far["in sd, truth's doubt granted"] == pytest.approx(50 / np.hypot(10, 20), abs=0.01)
    assert parameter_counts(rows) == {
        "stated": 6, "beyond 3 sd": 1, "beyond 3 sd, truth's doubt granted": 0, "focals called identifiable": 4,
        "of them over 3 % off": 1,
    }  # fmt: skip
    assert claimed_errors(rows) == {"claimed focal %": 2.0, "claimed center %": 1.0, "focal of 3 % or 3 sd": 1.667}


def test_a_guess_claims_nothing_before_and_a_wide_deviation_nothing_after(tmp_path):
    truth = left_behind(tmp_path, None, (camera_matrix(1400.0, 1400.0, 400.0, 300.0), {"fx": 200.0, "fy": 200.0}))
    rows = parameter_errors(tmp_path, truth, Doubt(0.0, 0.0))
    assert {row["when"] for row in rows} == {"after"}
    assert parameter_counts(rows)["focals called identifiable"] == 0
    assert claimed_errors(rows) == {"claimed focal %": 0.0, "claimed center %": 0.0, "focal of 3 % or 3 sd": 0.667}
    assert parameter_errors(tmp_path / "nothing", truth, Doubt(0.0, 0.0)) == []


def model(places):
    return Model(walk(places), {}, 1, 1, 0.1)


def test_a_fold_counts_unless_it_is_said_or_cut_into_honest_parts():
    two_ways = [*range(10), *range(10)]
    silent = walk_figures([model(two_ways)], ["scene  20 of 20 photos placed"])
    said = walk_figures([model(two_ways)], ["photos 003 and 013 may be folded onto one place"])
    parts = walk_figures([model(range(10)), model(range(8))], [])
    sure = walk_figures([model(two_ways)], ["look-alikes separated, 20 pairs of photos"])
    assert [unreported_fold("oats23", row) for row in (silent, said, parts, sure)] == [1, 0, 0, 1]
    assert unreported_fold("oats23", {}) is None and unreported_fold("castle-P19", silent) is None
    assert parts["axis of the worst part"] == pytest.approx(1.0)


def run_row(**figures):
    fine = {"photos": "fox50", "method": "sfm-app", "exit code": 0, "bar met": "yes"}
    return fine | {"behind stock": "", "clearly behind stock": ""} | figures


def stated_row(in_sd, identifiable="no", error=0.1):
    return {
        "photos": "fox50", "parameter": "fx", "in sd": in_sd, "in sd, truth's doubt granted": in_sd,
        "identifiable": identifiable, "error %": error,
    }  # fmt: skip


def test_one_parameter_of_twenty_may_be_off_and_no_exception_passes():
    fine = [stated_row(1.0)] * 19 + [stated_row(4.0)]
    assert [demand.met for demand in demands([run_row()], fine)] == [True] * 5
    bad = run_row(**{"exit code": 1, "bar met": "no: x", "clearly behind stock": "AUC@5"})
    broken = demands([bad], [*fine[1:], stated_row(9.0, "yes", 16.0)])
    assert [demand.met for demand in broken] == [False] * 5
    assert not demands([run_row(**{"exit code": None})], fine)[0].met


def photos_in(folder, count, size=(40, 30)):
    folder.mkdir(parents=True)
    for k in range(count):
        Image.new("RGB", size, (9 * k, 0, 0)).save(folder / f"{k:04d}.png")


def test_every_so_many_photos_are_taken(tmp_path):
    photos_in(tmp_path / "data" / "video" / "images", 12)
    found = photo_set(tmp_path / "data", "video", "crop:10,0+every:5", tmp_path / "cache")
    assert sorted(path.stem for path in found.folder.glob("*.png")) == ["0000", "0005", "0010"]
    with Image.open(found.folder / "0005.png") as image:
        assert image.size == (30, 30)
    assert (stride(""), stride("every:3"), steps("every:5+scale:2,2")) == (1, 3, [("scale", (2.0, 2.0))])
    with pytest.raises(ValueError):
        stride("every:0")


def test_what_takes_too_long_is_ended_with_all_that_it_started(tmp_path):
    alive = tmp_path / "alive"
    child = f"import time, pathlib; time.sleep(2); pathlib.Path({str(alive)!r}).touch()"
    parent = f"import subprocess, sys, time; subprocess.Popen([sys.executable, '-c', {child!r}]); time.sleep(60)"
    assert run_command([sys.executable, "-c", parent], 1.0)[0] is None
    time.sleep(2)
    assert not alive.exists()
    assert run_command([sys.executable, "-c", "import sys; sys.exit('no photos')"]) == (1, "no photos")
    hinted = "import sys; sys.exit('error: no photos\\nhint: take some')"
    assert run_command([sys.executable, "-c", hinted]) == (1, "error: no photos")


def options(tmp_path, **changed):
    given = {"keep": True, "score_only": False, "limit_min": 1.0, "sets": ["a"], "data": tmp_path, "cache": tmp_path}
    return argparse.Namespace(**given | changed)


def test_finished_runs_are_kept_until_program_settings_or_photos_change(tmp_path, monkeypatch):
    photos_in(tmp_path / "data" / "a" / "images", 2)
    photos = photo_set(tmp_path / "data", "a", "", tmp_path / "cache")
    ours, stock = methods({})[0], methods({})[1]
    said = {"exit code": 0, "wall seconds": 5.0}
    monkeypatch.setattr(kept_runs, "run", lambda *_: said)
    out = tmp_path / "out"

    assert kept_runs.reusable_run(ours, photos, out, options(tmp_path)) is None
    done = kept_runs.run_and_record(ours, photos, out, 60.0)
    assert kept_runs.reusable_run(ours, photos, out, options(tmp_path)) == done
    assert kept_runs.reusable_run(ours, photos, out, options(tmp_path, keep=False)) is None
    assert kept_runs.reusable_run(stock, photos, out, options(tmp_path)) is None
    assert kept_runs.reusable_run(stock, photos, out, options(tmp_path, score_only=True)) == done
    said |= {"exit code": None, "wall seconds": 60.0}
    kept_runs.run_and_record(ours, photos, out, 60.0)
    assert kept_runs.reusable_run(ours, photos, out, options(tmp_path)) is not None
    assert kept_runs.reusable_run(ours, photos, out, options(tmp_path, limit_min=2.0)) is None, "it gets more time"
    photos_in(photos.folder / "more", 1)
    (photos.folder / "more" / "0000.png").rename(photos.folder / "0002.png")
    assert kept_runs.reusable_run(ours, photos, out, options(tmp_path)) is None


def test_a_set_that_cannot_be_read_is_no_end_of_the_others(tmp_path, monkeypatch, capsys):
    args = options(tmp_path, sets=["gone", "gone crop:1,1"], results=tmp_path, name="corpus")
    rows = [row for row, _ in corpus.run_all(args, methods({}, ours_only=True))]
    assert [row["photos"] for row in rows] == ["gone", "gone crop:1,1"]
    assert all(row["failed"].startswith("benchmark: FileNotFoundError") for row in rows)
    assert len(re.findall(r"^\[\d/2\] gone", capsys.readouterr().err, re.MULTILINE)) == 2
    assert "benchmark: FileNotFoundError" in corpus.publish(args, methods({}), rows, [])
