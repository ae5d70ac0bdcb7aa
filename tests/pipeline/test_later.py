"""Photos that are added to, taken from, and replaced in the folder of a finished run."""

import json
import shutil
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image

import sfm_app
from sfm_app.colmap.database import photo_names, read_features
from sfm_app.geometry.poses import robust_similarity
from sfm_app.settings import Settings
from sfm_app.stages import scene as scene_stage
from sfm_app.types.scene import camera_center

pytestmark = pytest.mark.slow

NO_REPORT = {"quality": "draft", "report": False, "matching": {"max_image_size_px": 360}}
"""Drawing its figures would take as long as the rest of the scene."""
DRAFT = Settings.from_mapping(NO_REPORT)
FIRST = 5
"""Photos of the first run; two more come later."""


def reconstruct(photos, out, settings=DRAFT, **options):
    return sfm_app.reconstruct(photos, out, settings, last="scene", **options)


@pytest.fixture(scope="module")
def first(rendered, tmp_path_factory):
    """A finished run of the first photos."""
    place = tmp_path_factory.mktemp("later")
    (place / "photos").mkdir()
    names = sorted(path.name for path in rendered[0].iterdir())
    for name in names[:FIRST]:
        shutil.copyfile(rendered[0] / name, place / "photos" / name)
    run = reconstruct(place / "photos", place / "out")
    assert set(run.scene.registered) == set(names[:FIRST])
    return SimpleNamespace(place=place, names=names, all=rendered[0], truth=rendered[1])


@pytest.fixture
def folder(first, tmp_path):
    """The folder and the run, copied: laid-out photos are links to the folder, and are laid out again."""
    shutil.copytree(first.place / "photos", tmp_path / "photos")
    shutil.copytree(first.place / "out", tmp_path / "out", symlinks=True)
    return tmp_path / "photos", tmp_path / "out"


def add(photos, first, *numbers):
    for number in numbers:
        shutil.copyfile(first.all / first.names[number], photos / first.names[number])


def counts(run, stage):
    return run.manifest["stages"][stage]["counts"]


def largest_error(run, truth):
    """Largest distance of a camera from its true place, as a share of the extent of all."""
    names = sorted(run.scene.registered)
    found, true = (
        np.array([camera_center(poses[name]) for name in names])
        for poses in (run.scene.cam_from_world, truth.cam_from_world)
    )
    moved = robust_similarity(found, true)
    at = moved.scale * found @ moved.R.T + moved.t
    return float(np.max(np.linalg.norm(at - true, axis=1)) / np.ptp(true, axis=0).max())


def test_new_photos_are_placed_in_the_model_that_is_there(first, folder, monkeypatch):
    photos, out = folder
    before = read_features(out / "database.db")
    add(photos, first, 5, 6)
    monkeypatch.setattr(scene_stage, "reconstruct", None)  # nothing is mapped from the start

    run = reconstruct(photos, out)

    assert set(run.scene.registered) == set(first.names) and largest_error(run, first.truth) < 0.01
    assert counts(run, "match_graph")["known_photos"] == FIRST and counts(run, "match_graph")["new_photos"] == 2
    assert counts(run, "view_graph")["known_pairs"] == FIRST * (FIRST - 1) // 2
    assert next(iter(counts(run, "intrinsics")["cameras"].values()))["method"] == "earlier run"
    assert counts(run, "scene")["mapper"] == "grown" and counts(run, "scene")["mapped_again_because"] == ""
    after = read_features(out / "database.db")
    assert all(np.array_equal(after[1][pair], rows) for pair, rows in before[1].items())
    assert not (out / ".earlier").exists()
    again = reconstruct(photos, out)
    assert again.manifest == run.manifest


def test_the_same_history_gives_the_same_bytes(first, folder, tmp_path):
    photos, out = folder
    shutil.copytree(out, tmp_path / "other", symlinks=True)
    add(photos, first, 5, 6)
    results = []
    for place, workers in ((out, 1), (tmp_path / "other", 2)):
        run = reconstruct(photos, place, Settings.from_mapping(NO_REPORT | {"workers": workers}))
        files = [*sorted((place / "sparse").iterdir()), place / "view_graph.npz", place / "scene.json"]
        results.append(([path.read_bytes() for path in files], run.scene.cam_from_world.keys()))
    assert results[0] == results[1]


def test_photos_that_are_taken_away_leave(first, folder):
    photos, out = folder
    (photos / first.names[0]).unlink()
    run = reconstruct(photos, out)
    assert set(run.scene.registered) == set(first.names[1:FIRST]) and largest_error(run, first.truth) < 0.01
    assert counts(run, "match_graph")["gone_photos"] == 1
    assert set(photo_names(out / "database.db").values()) == set(first.names[1:FIRST])
    assert first.names[0] not in json.dumps(json.loads((out / "scene.json").read_text()))


def test_a_replaced_photo_is_a_new_one_and_a_renamed_one_too(first, folder):
    photos, out = folder
    with Image.open(photos / first.names[1]) as image:
        image.save(photos / first.names[1], quality=80)
    (photos / first.names[2]).rename(photos / "zz.jpg")
    before = read_features(out / "database.db")[0]
    ids = {name: key for key, name in photo_names(out / "database.db").items()}

    run = reconstruct(photos, out)

    assert counts(run, "match_graph")["known_photos"] == FIRST - 2
    after = {name: key for key, name in photo_names(out / "database.db").items()}
    assert after["zz.jpg"] > max(ids.values()) and after[first.names[1]] > max(ids.values())
    assert set(run.scene.registered) == {*first.names[:2], *first.names[3:FIRST], "zz.jpg"}
    keypoints = read_features(out / "database.db")[0]
    assert not np.array_equal(keypoints[after[first.names[1]]], before[ids[first.names[1]]])
    assert np.array_equal(keypoints[after["zz.jpg"]], before[ids[first.names[2]]])


class Killed(BaseException):
    """What no program catches."""


def killed_in(monkeypatch, function, *arguments):
    """A run that ends in a function of a stage."""

    def fail(*_, **__):
        raise Killed

    with monkeypatch.context() as patch, pytest.raises(Killed):
        patch.setattr(f"sfm_app.stages.{function}", fail)
        reconstruct(*arguments)


def test_a_run_that_was_killed_goes_on_from_the_earlier_one(first, folder, monkeypatch):
    photos, out = folder
    add(photos, first, 5, 6)
    killed_in(monkeypatch, "match_graph.wants_all_pairs", photos, out)
    run = reconstruct(photos, out)
    assert counts(run, "scene")["mapper"] == "grown" and set(run.scene.registered) == set(first.names)
    assert not (out / ".earlier").exists()


def test_photos_that_change_again_in_a_killed_run_are_told_from_the_finished_one(first, folder, monkeypatch):
    photos, out = folder
    add(photos, first, 5)
    killed_in(monkeypatch, "scene._finish_scene", photos, out)
    add(photos, first, 6)
    (photos / first.names[0]).unlink()
    run = reconstruct(photos, out)
    assert set(run.scene.registered) == set(first.names[1:])
    assert counts(run, "match_graph")["known_photos"] == FIRST - 1
    assert counts(run, "scene")["mapper"] == "grown"
