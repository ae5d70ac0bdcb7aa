"""The scene: adjusted models, their files and figures."""

import json
import shutil
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from itertools import combinations
from types import SimpleNamespace

import numpy as np
import pytest

from sfm_app.camera.models import camera_matrix
from sfm_app.colmap import bundle
from sfm_app.colmap.backend import pycolmap
from sfm_app.colmap.database import open_database
from sfm_app.colmap.model import posed_photo_ids, submodel
from sfm_app.errors import ReconstructionError
from sfm_app.mapping import passes
from sfm_app.mapping.attempt import Attempt, PairSupport
from sfm_app.mapping.passes import Outcome, Trial
from sfm_app.plugins import load_plugins
from sfm_app.products import read_scene, write_scene, write_sparse_models
from sfm_app.report.text import scene_lines
from sfm_app.runtime.context import RunContext
from sfm_app.runtime.workspace import MAPPING, Workspace
from sfm_app.settings import Settings
from sfm_app.stages import scene
from sfm_app.types import (
    Calibration,
    CameraModel,
    EpipolarFit,
    Evidence,
    Intrinsics,
    MatchedImage,
    MatchGraph,
    PoseGraph,
    RelativePose,
    Scene,
    ViewGraph,
)

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def synthetic(tmp_path_factory):
    """Eight photos of COLMAP's making: their database and the true model."""
    place = tmp_path_factory.mktemp("synthetic")
    pycolmap.set_random_seed(1)
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_cameras_per_rig, options.num_frames_per_rig = 1, 1, 8
    options.num_points3D, options.camera_params = 100, [1280.0, 512.0, 384.0, 0.0]
    noise = pycolmap.SyntheticNoiseOptions()
    noise.point2D_stddev = 0.2
    with open_database(place / "database.db") as database:
        model = pycolmap.synthesize_dataset(options, database)
        pycolmap.synthesize_noise(noise, model, database)
    return place / "database.db", model


@pytest.fixture
def run(synthetic, tmp_path):
    """A run in an empty folder."""
    settings = Settings.from_mapping({"scene": {"without": ["finer-features"]}})
    return RunContext(settings, Workspace(tmp_path), load_plugins(), ThreadPoolExecutor(1), 1)


@pytest.fixture
def mapped(synthetic, monkeypatch):
    """Lets mapping find what the test says; the database that it has made is COLMAP's."""

    def find(made):
        def reconstruct(evidence, run):
            shutil.copyfile(synthetic[0], run.workspace.database)
            intrinsics = made.evidence.intrinsics
            return replace(
                made, evidence=replace(evidence, intrinsics=intrinsics), calibrated=evidence.intrinsics, run=run
            )

        monkeypatch.setattr(scene, "reconstruct", reconstruct)

    return find


def attempt(model, explained=None):
    return Attempt("global", model, explained or {}, "all at once")


def outcome(*attempts, graph=None, **others):
    cameras = Intrinsics({"one": Calibration(camera_matrix(1280, 1280, 512, 384), 1024, 768, "zero-curves", True)})
    evidence, graph = Evidence(None, None, cameras), graph or PoseGraph({}, {}, ())
    return Outcome(attempts, graph, evidence, cameras, None, **{"reason": "it explains more"} | others)


def trial(*notes):
    return Trial("first-pass", "", True, (0, 4), (0.0, 123.456), 7.89, notes)


def pose(kind, guided=False):
    return RelativePose(np.eye(3), np.eye(3)[0], np.ones(20, bool), 10.0, 1.0, kind, guided)


def inputs(model, fits=((1, 8),)):
    images = {key: MatchedImage(key, model.images[key].name, "one", 1024, 768) for key in sorted(model.images)}
    fit = EpipolarFit(np.eye(3), np.ones(20, bool), np.ones(20), 10, 0.3)
    return MatchGraph(images, dict.fromkeys(images, np.ones((20, 2))), {}), ViewGraph(dict.fromkeys(fits, fit), {})


def test_the_main_model_is_adjusted_and_read_and_the_others_lie_beside_it(synthetic, run, mapped):
    true = synthetic[1]
    main, other = submodel(true, (1, 2, 3, 4)), submodel(true, (5, 6, 7))
    for camera in main.cameras.values():
        camera.params = [1270.0, 512.0, 384.0, 0.0]
    made = outcome(attempt(main), attempt(other), graph=PoseGraph({}, {(1, 8): "contradicts other pairs"}, ()))
    mapped(made)
    matches, views = inputs(true)
    name = {key: image.name for key, image in matches.images.items()}

    found = scene.make(matches, views, made.calibrated, run)

    assert sorted(found.cam_from_world) == [name[key] for key in (1, 2, 3, 4)]
    assert found.cameras["one"].K[0, 0] == pytest.approx(1280, rel=0.003)
    assert 0.1 < found.mean_reprojection_px < 0.5
    assert found.unregistered == {
        **{name[key]: "belongs to another model, of 3 photos" for key in (5, 6, 7)},
        name[8]: "could not be placed: 20 inliers with the nearest placed photo, "
        "but that pair was dropped: contradicts other pairs",
    }
    assert run.statistics["registered"] == 4 and run.statistics["of"] == 8
    assert run.statistics["other_models"] == [[name[key] for key in (5, 6, 7)]]
    assert run.statistics["pairs_dropped"] == {"contradicts other pairs": 1}
    assert posed_photo_ids(pycolmap.Reconstruction(run.workspace.other_models / "1")) == [5, 6, 7]

    again = read_scene(run.workspace)
    assert again.unregistered == found.unregistered and again.points == found.points
    assert all(np.array_equal(again.cam_from_world[key], value) for key, value in found.cam_from_world.items())


def test_a_photo_that_contradicts_its_place_is_left_out_with_the_reason(synthetic, run, mapped, monkeypatch):
    true = synthetic[1]
    graph = PoseGraph({(1, 8): pose("calibrated")}, {}, ())
    made = outcome(attempt(true, {(1, 8): PairSupport(20, 20, 0)}), graph=graph)
    mapped(made)
    monkeypatch.setattr(passes, "find_misplaced", lambda *_: {8: 0.9})
    matches, views = inputs(true)
    matches = replace(matches, matches={(1, 8): np.zeros((20, 2), np.uint32)})

    found = scene.make(matches, views, made.calibrated, run)

    left_out = matches.images[8].name
    assert found.unregistered == {left_out: passes.MISPLACED} and len(found.registered) == 7
    assert run.statistics["look_alikes"] == [
        {"pairs": 1, "between": [[matches.images[1].name], [left_out]], "missing": 0.9}
    ]


def test_cameras_that_mapping_divided_are_read_back(synthetic, run, mapped):
    true = synthetic[1]
    made = outcome(attempt(pycolmap.Reconstruction(true)))
    matches, views = inputs(true)
    one = made.calibrated.cameras["one"]
    last = matches.images[8].name
    divided = Intrinsics({"one": one, "one #2": one}, {last: "one #2"})
    mapped(replace(made, evidence=replace(made.evidence, intrinsics=divided)))

    found = scene.make(matches, views, made.calibrated, run)

    assert (found.camera_of[last], len(found.cameras)) == ("one #2", 2)
    again = read_scene(run.workspace)
    assert again.camera_of == found.camera_of and again.cameras.keys() == found.cameras.keys()


def test_what_mapping_found_stays_when_it_is_interrupted(run, monkeypatch):
    def reconstruct(evidence, inner):
        (inner.workspace.root / "found").mkdir()
        raise KeyboardInterrupt

    monkeypatch.setattr(scene, "reconstruct", reconstruct)

    with pytest.raises(KeyboardInterrupt):
        scene.make(MatchGraph({}, {}, {}), None, Intrinsics({}), run)

    assert (run.workspace.root / MAPPING / "found").exists()
    assert (scene.mapping_run(run).workspace.root / "found").exists()
    other = run.with_fingerprint("other photos")
    assert not (scene.mapping_run(other).workspace.root / "found").exists()


def test_a_model_that_cannot_be_adjusted_is_kept_and_the_run_says_so(synthetic, run, mapped, monkeypatch):
    def failing(*_):
        raise np.linalg.LinAlgError("Matrix is not positive definite")

    true = synthetic[1]
    made = outcome(attempt(submodel(true, (1, 2, 3, 4))), attempt(submodel(true, (5, 6, 7))))
    mapped(made)
    monkeypatch.setattr(bundle, "reduce", failing)
    matches, views = inputs(true)

    found = scene.make(matches, views, made.calibrated, run)

    reason = "the computation failed while adjusting the bundle: Matrix is not positive definite"
    assert run.statistics["adjustment"] == {"failed": reason, "failed_in_other_models": {"1": reason}}
    assert len(found.cam_from_world) == 4 and found.cameras["one"].params == (1280.0, 512.0, 384.0, 0.0)
    assert (found.cameras["one"].deviations, found.cameras["one"].determined) == ({}, ())
    assert json.loads(run.workspace.scene.read_text(), parse_constant=pytest.fail)["cameras"]["one"]
    assert "the last adjustment failed" in "\n".join(scene_lines(found, run.statistics))


def test_without_a_model_the_error_says_what_was_seen_and_what_may_help(synthetic, run, mapped):
    mapped(outcome(trials=(trial("all at once: 0 photos"),)))
    matches, views = inputs(synthetic[1])
    with pytest.raises(ReconstructionError, match=r"1 pairs with 20 to 20 inliers\); all at once: 0 photos") as caught:
        scene.make(matches, views, outcome().calibrated, run)
    assert "overlap" in caught.value.hint
    assert not run.workspace.sparse.exists() and run.statistics == {}
    assert not (run.workspace.root / MAPPING).exists()


def test_how_it_was_made_counts_pairs_and_matches():
    kinds = ["calibrated", "planar", "calibrated", "rotation"]
    pairs = zip(combinations(range(4), 2), kinds, strict=False)
    poses = {pair: pose(kind, guided=kind == "planar") for pair, kind in pairs}
    dropped = {(1, 3): "contradicts other pairs", (2, 3): "contradicts other pairs", (1, 2): "points behind a camera"}
    explained = {(0, 1): PairSupport(50, 40, 3), (0, 2): PairSupport(60, 50, 4)}
    made = attempt(SimpleNamespace(num_reg_images=lambda: 4), explained)

    found = outcome(made, graph=PoseGraph(poses, dropped, ()), cuts=("c, d",), trials=(trial("a", "b"),))

    assert scene.mapping_figures(found) == {
        "mapper": "global", "mapper_reason": "it explains more",
        "hypotheses": [{
            "name": "first-pass", "reason": "", "accepted": True, "photos": (0, 4), "support": [0.0, 123.5],
            "seconds": 7.9, "notes": ("a", "b"), "failure": "",
        }],
        "explained_matches": 110, "contradicted_matches": 7, "cut_apart": ["c, d"],
        "pairs": {"calibrated": 2, "planar": 1, "rotation": 1, "found with the help of others": 1},
        "pairs_dropped": {"contradicts other pairs": 2, "points behind a camera": 1},
    }  # fmt: skip


def files(folder):
    return sorted(str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file())


def test_models_are_written_as_a_whole_and_nothing_of_an_earlier_run_is_left(synthetic, run):
    place = run.workspace
    parts = [submodel(synthetic[1], photos) for photos in ((1, 2, 3, 4), (5, 6), (7, 8))]
    for folder in (place.sparse, place.other_models / "7", place.root / ".sparse.unfinished"):
        folder.mkdir(parents=True)
        (folder / "old.bin").write_bytes(b"old")

    write_sparse_models(parts, place)

    written = files(place.sparse)
    assert "images.bin" in written and "old.bin" not in written
    assert sorted(path.name for path in place.other_models.iterdir()) == ["1", "2"]
    assert sorted(path.name for path in place.root.iterdir()) == ["other_models", "sparse"]
    found = [place.sparse, place.other_models / "1", place.other_models / "2"]
    assert [posed_photo_ids(pycolmap.Reconstruction(folder)) for folder in found] == [[1, 2, 3, 4], [5, 6], [7, 8]]

    write_sparse_models(parts[1:2], place)

    assert posed_photo_ids(pycolmap.Reconstruction(place.sparse)) == [5, 6]
    assert not place.other_models.exists()


def test_what_the_model_does_not_hold_is_written_down(tmp_path):
    place = Workspace(tmp_path)
    K = camera_matrix(800.0, 800.0, 320.0, 240.0)
    camera = CameraModel("OPENCV", (800.0,) * 8, K, 640, 480, {"fx": 1.5, "cx": 2.5}, ("center",))

    write_scene(Scene(tmp_path, {}, {"b.jpg": "blurred"}, {"one": camera}, 10, 20, 0.3, {"a.jpg": "one"}), place)

    found = json.loads(place.scene.read_text())
    assert found["cameras"]["one"]["deviations"] == {"fx": 1.5, "cx": 2.5}
    assert (found["cameras"]["one"]["K"], found["cameras"]["one"]["determined"]) == (K.tolist(), ["center"])
    assert (found["camera_of"], found["unregistered"]) == ({"a.jpg": "one"}, {"b.jpg": "blurred"})
