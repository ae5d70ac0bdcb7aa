"""Cameras that an earlier run has refined stay, unless new photos contradict them."""

import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from sfm_app.camera.models import camera_matrix
from sfm_app.estimation import known as module
from sfm_app.estimation.known import find_or_keep_intrinsics, known_cameras, refined_camera
from sfm_app.selfcal import CalibratedCamera
from sfm_app.settings import Settings
from sfm_app.types import Calibration, GivenCameras, Intrinsics, MatchedImage, MatchGraph, ViewGraph

REFINED = {
    "model": "OPENCV", "params": [900.0, 905.0, 500.0, 375.0, -0.1, 0.01, 0.0, 0.0], "width": 1000, "height": 750,
    "K": camera_matrix(900.0, 905.0, 500.0, 375.0).tolist(),
    "deviations": {"fx": 1.5, "fy": 1.5, "cx": 2.0, "cy": 2.0}, "determined": ["aspect", "k1"],
}  # fmt: skip
KNOWN = ("a", "b", "c", "d")


def photo_graph(*names, group="one", exif=None):
    images = {
        k: MatchedImage(k, name, group, 1000, 750, exif_focal_px=None if name in KNOWN else exif)
        for k, name in enumerate(names, start=1)
    }
    return MatchGraph(images, {k: np.zeros((0, 2)) for k in images}, {})


@pytest.fixture
def run(tmp_path):
    (tmp_path / "scene.json").write_text(
        json.dumps({"cameras": {"one": REFINED}, "camera_of": dict.fromkeys(KNOWN, "one"), "unregistered": {}})
    )
    said, figures = [], {}
    earlier = SimpleNamespace(
        place=SimpleNamespace(scene=tmp_path / "scene.json"), stages=("scene",), known=frozenset(KNOWN)
    )
    return SimpleNamespace(
        earlier=earlier, given=GivenCameras(), settings=Settings(), seed=0, said=said, figures=figures,
        progress=SimpleNamespace(say=said.append), record=lambda **more: figures.update(more),
        plugins=SimpleNamespace(calibrator=lambda _: SimpleNamespace(calibrate=None, together=True)),
    )  # fmt: skip


def kept(run, matches):
    return known_cameras(matches, ViewGraph({}, {}), run, run.earlier)


def test_a_refined_camera_is_a_start_with_its_deviations():
    found = refined_camera(REFINED)

    assert found.identifiable and not found.is_given and found.spread["fx"] == 1.5
    assert np.allclose(found.K, REFINED["K"]) and found.distortion[:2] == (-0.1, 0.01)
    assert found.held == ("center",)
    assert refined_camera(None) is None
    assert refined_camera(REFINED | {"deviations": {}}) is None


def test_it_stays_where_most_photos_of_its_group_are_known(run):
    assert kept(run, photo_graph(*KNOWN, "e", "f")).keys() == {"one"}
    assert kept(run, photo_graph("a", "b", "e", "f")) == {}
    assert kept(run, photo_graph(*KNOWN, "e", group="another size")) == {}


def test_a_group_that_was_split_is_calibrated_again(run, tmp_path):
    of = {"a": "one", "b": "one", "c": "one/2", "d": "one/2"}
    (tmp_path / "scene.json").write_text(json.dumps({"cameras": {"one": REFINED}, "camera_of": of}))

    assert kept(run, photo_graph(*KNOWN)) == {}


def test_exif_of_the_new_photos_may_contradict_it(run):
    assert kept(run, photo_graph(*KNOWN, "e", exif=910.0)).keys() == {"one"}
    assert kept(run, photo_graph(*KNOWN, "e", exif=1800.0)) == {}
    assert "EXIF says 1800" in run.said[0]


@pytest.mark.parametrize(("focal", "stays"), [(903.0, True), (870.0, True), (1100.0, False)])
def test_pairs_of_the_new_photos_may_contradict_it(run, monkeypatch, focal, stays):
    own = Calibration(
        camera_matrix(focal, focal, 500.0, 475.0), 1000, 750, "zero-curves", True, spread={"fx": 8.0, "cy": 5.0}
    )
    monkeypatch.setattr(module, "photo_pairs", lambda *_: SimpleNamespace(photos=((5, 6),)))
    monkeypatch.setattr(module, "calibrate_photo_set", lambda *_, **__: [CalibratedCamera("one", (5, 6), own)])
    camera = {**REFINED, "params": [900.0, 900.0, 500.0, 375.0, 0.0, 0.0, 0.0, 0.0]}
    run.earlier.place.scene.write_text(
        json.dumps({"cameras": {"one": camera}, "camera_of": dict.fromkeys(KNOWN, "one")})
    )

    assert bool(kept(run, photo_graph(*KNOWN, "e", "f"))) is stays
    assert bool(run.said) is not stays


@pytest.mark.parametrize("told", [True, False])
def test_new_groups_are_calibrated_alone_or_all_together_where_that_fails(run, monkeypatch, told):
    matches = photo_graph(*KNOWN, "e")
    phone = {k: MatchedImage(k, f"phone {k}", "phone", 800, 600) for k in (6, 7)}
    keypoints = dict.fromkeys(range(1, 8), np.zeros((0, 2)))
    matches = replace(matches, images=dict(matches.images) | phone, keypoints=keypoints)
    asked = []

    def find(some, views, run):
        asked.append({image.group for image in some.images.values()})
        camera = CalibratedCamera("phone", tuple(some.images), Calibration(np.eye(3), 800, 600, "some", told))
        return Intrinsics({"phone": camera.found}), [camera]

    monkeypatch.setattr(module, "find_intrinsics", find)
    found, cameras = find_or_keep_intrinsics(matches, ViewGraph({}, {}), run)

    if not told:
        assert asked == [{"phone"}, {"one", "phone"}] and run.figures == {}
        return
    assert asked == [{"phone"}] and list(found.cameras) == ["one", "phone"]
    assert found.camera_of == dict.fromkeys([*KNOWN, "e"], "one") | {"phone 6": "phone", "phone 7": "phone"}
    assert run.figures == {"kept_cameras": ["one"]}
    assert [camera.photos for camera in cameras] == [(1, 2, 3, 4, 5), (6, 7)]
