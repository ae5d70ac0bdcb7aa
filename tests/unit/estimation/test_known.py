"""Fits and cameras of an earlier run."""

import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from sfm_app.camera.models import camera_matrix
from sfm_app.colmap.database import write_match_graph
from sfm_app.estimation import calibrating as module
from sfm_app.estimation.calibrating import find_or_keep_intrinsics, known_cameras, refined_camera
from sfm_app.estimation.fitting import known_fits, known_lenses
from sfm_app.matching.pairs import find_same_matches, pairs_with_new_photos
from sfm_app.selfcal import CalibratedCamera
from sfm_app.settings import Settings
from sfm_app.types import (
    Calibration,
    CameraPrior,
    EpipolarFit,
    GivenCameras,
    Intrinsics,
    MatchedImage,
    MatchGraph,
    Rejected,
    ViewGraph,
)

ROWS = np.column_stack([np.arange(4), np.arange(4)[::-1]]).astype(np.uint32)


def image(key, group="one", name=None):
    return MatchedImage(key, name or f"{key}.jpg", group, 100, 80)


def graph(photos=(1, 2, 3), **others):
    keypoints = {key: np.float64(np.float32(np.random.default_rng(key).uniform(0, 80, (5, 2)))) for key in photos}
    matches = {(a, b): ROWS for a in photos for b in photos if a < b}
    return replace(MatchGraph({key: image(key) for key in photos}, keypoints, matches), **others)


def earlier_run(folder, before, known):
    path = folder / "earlier.db"
    write_match_graph(path, before)
    return SimpleNamespace(place=SimpleNamespace(database=path), known=frozenset(known))


def fit(count=4):
    return EpipolarFit(np.eye(3), np.ones(count, bool), np.ones(count), 10, 0.5)


def test_pairs_with_the_same_bytes_are_the_same(tmp_path):
    earlier = earlier_run(tmp_path, graph(), {"1.jpg", "2.jpg", "3.jpg"})
    now = graph((1, 2, 3, 4))
    same = find_same_matches(now, earlier)
    assert same.photos == {1, 2, 3} and same.pairs == {(1, 2), (1, 3), (2, 3)}
    other = find_same_matches(replace(now, matches=now.matches | {(1, 3): ROWS[:3]}), earlier)
    assert other.photos == {1, 2, 3} and other.pairs == {(1, 2), (2, 3)}


def test_photos_with_other_keypoints_names_or_contents_are_not_the_same(tmp_path):
    earlier = earlier_run(tmp_path, graph(), {"1.jpg", "2.jpg"})
    now = graph()
    assert find_same_matches(now, earlier).photos == {1, 2}  # the third was replaced
    moved = replace(now, keypoints=now.keypoints | {1: now.keypoints[1] + 0.5})
    assert find_same_matches(moved, earlier).photos == {2}
    swapped = replace(now, images=now.images | {1: image(1, name="2.jpg"), 2: image(2, name="1.jpg")})
    assert find_same_matches(swapped, earlier).photos == frozenset()


def test_pairs_of_known_photos_are_not_matched_again():
    images = {key: image(key) for key in (1, 2, 3)}
    assert pairs_with_new_photos([(1, 2), (1, 3), (2, 3)], images, {"1.jpg", "2.jpg"}) == [(1, 3), (2, 3)]
    assert pairs_with_new_photos([(1, 2)], images, set()) == [(1, 2)]


@pytest.fixture
def lens():
    return Calibration(np.eye(3), 100, 80, "lens", True, projection="fisheye", distortion=(0.1,))


def test_fits_stay_where_matches_and_lenses_are_the_same(lens):
    images = {1: image(1), 2: image(2), 3: image(3, "wide"), 4: image(4)}
    matches = graph((1, 2, 3, 4), images=images)
    before = ViewGraph({(1, 2): fit(), (1, 3): fit()}, {(2, 3): Rejected("too few")}, {"wide": lens})
    same = {(1, 2), (1, 3), (2, 3), (1, 4)}
    assert known_fits(matches, before, same, {"wide": lens}).keys() == {(1, 2), (1, 3), (2, 3)}
    assert known_fits(matches, before, same, {}).keys() == {(1, 2)}
    other = replace(lens, distortion=(0.2,))
    assert known_fits(matches, before, same, {"wide": other}).keys() == {(1, 2)}
    assert known_fits(matches, before, {(2, 3)}, {"wide": lens})[2, 3] is before.rejected[2, 3]


def test_lenses_stay_where_most_photos_are_known(lens):
    images = {key: image(key, "wide" if key < 4 else "usual" if key < 7 else "half") for key in range(1, 9)}
    matches = graph(range(1, 9), images=images)
    earlier = SimpleNamespace(known=frozenset({"1.jpg", "2.jpg", "4.jpg", "5.jpg", "7.jpg"}))
    found = known_lenses(matches, ViewGraph({}, {}, {"wide": lens, "half": lens}), earlier)
    assert found == {"wide": lens, "usual": None}


REFINED = {
    "model": "OPENCV", "params": [900.0, 905.0, 500.0, 375.0, -0.1, 0.01, 0.0, 0.0], "width": 1000, "height": 750,
    "K": camera_matrix(900.0, 905.0, 500.0, 375.0).tolist(),
    "deviations": {"fx": 1.5, "fy": 1.5, "cx": 2.0, "cy": 2.0}, "determined": ["aspect", "k1"],
}  # fmt: skip
KNOWN = ("a", "b", "c", "d")


def photo_graph(*names, group="one", exif=None):
    images = {
        k: MatchedImage(
            k,
            name,
            group,
            1000,
            750,
            prior=None if name in KNOWN or not exif else CameraPrior("EXIF", exif, 0.04 * exif),
        )
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
        return Intrinsics({"phone": camera.found})

    monkeypatch.setattr(module, "find_intrinsics", find)
    found = find_or_keep_intrinsics(matches, ViewGraph({}, {}), run)

    if not told:
        assert asked == [{"phone"}, {"one", "phone"}] and run.figures == {}
        return
    assert asked == [{"phone"}] and list(found.cameras) == ["one", "phone"]
    assert found.camera_of == dict.fromkeys([*KNOWN, "e"], "one") | {"phone 6": "phone", "phone 7": "phone"}
    assert run.figures == {"kept_cameras": ["one"]}
