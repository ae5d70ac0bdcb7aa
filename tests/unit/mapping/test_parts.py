"""Mapping in parts: from end to end, on a walk through a town; where parts fail; the files of a part."""

import json
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest

from benchmarks.synthetic.matches import TownOptions, make_town_graph
from sfm_app.colmap.database import write_calibrations, write_match_graph, write_pose_graph
from sfm_app.colmap.model import poses_and_points
from sfm_app.errors import BackendError, ClusterError
from sfm_app.geometry.poses import umeyama
from sfm_app.mapping import parts
from sfm_app.mapping.attempt import Attempt, Group, NoModel, PairSupport, best_attempt
from sfm_app.mapping.parts import (
    FOLDER,
    RESULT,
    PartInputs,
    PartResult,
    map_in_parts,
    map_part,
    part_of_group,
    part_size,
    parts_suffice,
    read_inputs,
    write_inputs,
)
from sfm_app.plugins import load_plugins
from sfm_app.posegraph import PoseGraphOptions, build_pose_graph
from sfm_app.runtime.context import RunContext
from sfm_app.runtime.parallel import make_executor
from sfm_app.runtime.workspace import Workspace
from sfm_app.settings import SceneSettings, Settings
from sfm_app.tasks import Task
from sfm_app.types import Calibration, EpipolarFit, Evidence, Intrinsics, LookAlikes, PoseGraph, RelativePose
from tests.unit.mapping.conftest import K

PHOTOS, PART = 72, 24


@pytest.fixture(scope="module")
def town():
    return make_town_graph(TownOptions(photos=PHOTOS, step_m=0.75, look_alikes=0.0), 0)


@pytest.fixture(scope="module")
def group(town):
    width, height = TownOptions().size
    camera = Calibration(town.K, width, height, "zero-curves", True, spread={"fx": 1.0})
    intrinsics = Intrinsics({"camera": camera})
    evidence = Evidence(town.matches, town.views, intrinsics)
    graph = build_pose_graph(evidence, PoseGraphOptions(1.5, 16, 0), lambda f, items, _: list(map(f, items)))
    return Group(graph.groups[0], evidence, graph)


@pytest.fixture
def start(group, tmp_path):
    """Maps the group in parts with some workers, in a folder of its own."""

    def run_with(workers=2, *, whole=False, group=group, stop_at_false_joins=True):
        place = Workspace(tmp_path / f"of-{workers}")
        place.photos.mkdir(parents=True)
        matches = group.evidence.matches
        write_match_graph(place.database, matches)
        write_calibrations(place.database, matches, group.evidence.intrinsics)
        write_pose_graph(place.database, matches, group.graph)
        settings = Settings.from_mapping({"scene": {"part_photos": PART}})
        with make_executor(workers) as executor:
            run = RunContext(settings, place, load_plugins(installed=False), executor, workers)
            found = map_in_parts(group, group.graph, run, stop_at_false_joins=stop_at_false_joins)
            return found if whole else (found[0], run)

    return run_with


def model_arrays(found):
    poses, points = poses_and_points(best_attempt(found).model)
    return np.array(list(poses.values())), points, list(poses)


@pytest.mark.slow
def test_parts_become_one_exact_model_with_all_photos_whatever_the_workers(town, group, start):
    (found, run), (again, other) = start(2), start(1)

    poses, _, photos = model_arrays(found)
    assert photos == sorted(group.photos) and len(photos) >= PHOTOS - 2
    centers = -np.einsum("nji,nj->ni", poses[:, :, :3], poses[:, :, 3])
    true = town.centers[np.array(photos) - 1]
    away = np.linalg.norm(umeyama(centers, true)(centers) - true, axis=1)
    assert 0.0005 < np.median(away) < 0.1 and away.max() < 0.5
    assert parts_suffice(found, len(group.photos))
    (figures,) = run.statistics["parts"]
    assert len(figures["parts"]) >= 3 and len(figures["joins"]) >= len(figures["parts"]) - 1
    assert not figures["dropped_joins"] and not figures["left_out"]
    assert all(join["photos"] >= 5 and join["explained"] > join["contradicted"] for join in figures["joins"])
    assert not (run.workspace.root / FOLDER).exists()
    for one, two in zip(model_arrays(found), model_arrays(again), strict=True):
        assert np.array_equal(one, two)
    assert other.statistics["parts"] == [figures]


@pytest.mark.slow
def test_a_part_that_fails_is_left_to_the_others(start, monkeypatch):
    made = []

    def some_fail(photos, folder):
        made.append(folder)
        return PartResult((), "", ("failed: no memory",)) if len(made) == 2 else map_part(photos, folder)

    monkeypatch.setattr("sfm_app.mapping.parts.map_part", some_fail)
    found, run = start(1)

    (figures,) = run.statistics["parts"]
    assert [part["tried"] for part in figures["parts"]][1] == ["failed: no memory"]
    joined, completed = found
    assert joined.photos < completed.photos
    assert best_attempt(found) is completed and completed.photos >= PHOTOS - 4


@pytest.mark.slow
def test_pairs_that_the_pose_graph_has_dropped_do_not_refuse_a_join(group, start):
    rng = np.random.default_rng(2)
    evidence = group.evidence
    rows, fits = dict(evidence.matches.matches), dict(evidence.views.fits)
    for a, b in rng.permutation([(a, b) for a in range(1, 24) for b in range(48, PHOTOS) if (a, b) not in rows])[:200]:
        count = min(300, *(len(evidence.matches.keypoints[photo]) for photo in (a, b)))
        pair = int(a), int(b)
        rows[pair] = np.column_stack([np.arange(count)] * 2).astype(np.uint32)
        fits[pair] = EpipolarFit(rng.normal(size=(3, 3)), np.ones(count, bool), np.ones(count), 9, 0.1)

    more = replace(evidence, matches=replace(evidence.matches, matches=rows), views=replace(evidence.views, fits=fits))
    found, run = start(group=replace(group, evidence=more))

    (figures,) = run.statistics["parts"]
    assert figures["dropped_joins"] == [] and len(figures["joins"]) >= len(figures["parts"]) - 1
    assert best_attempt(found).photos >= PHOTOS - 2


@pytest.mark.slow
def test_where_no_part_is_mapped_the_reason_is_told(group, start, monkeypatch):
    failed = PartResult((), "", ("failed: no memory",))
    monkeypatch.setattr(parts, "map_parts", lambda *_, **__: [failed] * 9)
    monkeypatch.setattr(parts, "cut_group", lambda *_: [parts.Part((k,), (k,)) for k in range(1, 10)])
    (found,) = start()[0]
    assert isinstance(found, NoModel) and found.note == "in 9 parts: no part has a model; failed: no memory"
    assert not parts_suffice([found], PHOTOS)


@pytest.mark.slow
@pytest.mark.parametrize(("error", "passes"), [(ClusterError("gone"), True), (BackendError("failed"), False)])
def test_a_cluster_that_is_gone_ends_the_run_and_other_failures_leave_the_whole(start, monkeypatch, error, passes):
    def fail(*_, **__):
        raise error

    monkeypatch.setattr(parts, "map_parts", fail)
    if passes:
        with pytest.raises(ClusterError, match="gone"):
            start()
    else:
        ((found,), _) = start()
        assert isinstance(found, NoModel) and "failed" in found.note


def test_the_size_of_parts_is_that_of_the_settings_or_usual_for_large_groups():
    auto, own = SceneSettings(), SceneSettings(part_photos=60)
    assert [part_size(count, auto) for count in (3, 400, 401, 9000)] == [0, 0, 150, 150]
    assert [part_size(count, own) for count in (90, 91, 1000)] == [0, 60, 60]
    assert part_size(100, SceneSettings(part_photos=1)) == 20


class _Model:
    def __init__(self, photos):
        self.photos = photos

    def num_reg_images(self):
        return self.photos

    def num_points3D(self):
        return 100


def attempt(photos, contradicted=0, mapper="parts", matches=100):
    return Attempt(mapper, _Model(photos), {(1, 2): PairSupport(matches, 100, contradicted)}, f"{photos} photos")


@pytest.mark.parametrize(("found", "good"), [
    ([attempt(200)], True), ([attempt(195)], True), ([attempt(180)], False), ([attempt(200, 6)], False), ([], False),
])  # fmt: skip
def test_a_model_of_parts_convinces_with_nearly_all_photos_and_few_contradictions(found, good):
    assert parts_suffice(found, 200) is good


@pytest.mark.slow
def test_parts_with_false_joins_are_not_joined_unless_nobody_asks(start, monkeypatch):
    join, more = LookAlikes(((1, 2), (3, 4)), 0.9), LookAlikes(((3, 4), (5, 6)), 0.7)
    results = [PartResult((), "", ("failed",), (one,)) for one in (join, more, join)]
    monkeypatch.setattr(parts, "map_parts", lambda *_, **__: results)
    monkeypatch.setattr(parts, "cut_group", lambda *_: [parts.Part((k,), (k,)) for k in (1, 2, 3)])
    assert start(1, whole=True) == ([], (join, LookAlikes(((5, 6),), 0.7)))
    found, joins = start(2, whole=True, stop_at_false_joins=False)
    assert joins == () and [one.note for one in found] == ["in 3 parts: no part has a model; failed"]


def test_a_task_is_small_and_travels(tmp_path):
    import pickle

    task = Task(map_part, tmp_path / "photos")
    assert len(pickle.dumps((task, tmp_path))) < 1000
    assert pickle.loads(pickle.dumps(task)).args == (tmp_path / "photos",)  # noqa: S301


def group_of(street):
    matches, views = street.graphs()
    poses = {
        pair: RelativePose(np.eye(3), np.array([0.6, 0.0, 0.8]), fit.inliers, 3.25, 0.9, "planar", sum(pair) % 2 == 0)
        for pair, fit in views.fits.items()
    }
    lens = Calibration(K, 1200, 900, "zero-curves", True, spread={"fx": 1.5}, key_pairs=((1, 2),))
    other = Calibration(K, 640, 480, "guess", False)
    intrinsics = Intrinsics({"one": lens, "two": other}, {"040.jpg": "two"})
    return Group(tuple(matches.images), Evidence(matches, views, intrinsics), PoseGraph(poses, {}, ()))


def test_a_part_of_a_group_has_what_concerns_its_photos(street):
    group = group_of(street)
    part = part_of_group(group, (3, 4, 5))
    own = part.evidence
    assert list(own.matches.images) == list(own.matches.keypoints) == [3, 4, 5]
    assert list(own.matches.matches) == list(own.views.fits) == list(part.graph.poses) == [(3, 4), (3, 5), (4, 5)]
    assert part.graph.groups == ((3, 4, 5),) and list(own.intrinsics.cameras) == ["one"]


def test_inputs_are_read_back_as_they_were(street, tmp_path):
    group = group_of(street)
    part = part_of_group(group, range(21, 41))
    settings = Settings.from_mapping({"seed": 7, "scene": {"part_photos": 33}})

    write_inputs(
        tmp_path / "a.npz", PartInputs(part, frozenset([(21, 22), (21, 23)]), settings, stop_at_false_joins=True)
    )
    write_inputs(
        tmp_path / "b.npz", PartInputs(part, frozenset([(21, 23), (21, 22)]), settings, stop_at_false_joins=True)
    )
    again = read_inputs(tmp_path / "a.npz")
    found, read_back, given = again.part, again.part.evidence, part.evidence

    assert (tmp_path / "a.npz").read_bytes() == (tmp_path / "b.npz").read_bytes()
    assert again.mapped == {(21, 22), (21, 23)} and again.settings == settings and again.stop_at_false_joins
    assert found.photos == part.photos and read_back.matches.images == given.matches.images
    assert list(read_back.matches.matches) == list(given.matches.matches)
    assert all(np.array_equal(read_back.matches.matches[pair], rows) for pair, rows in given.matches.matches.items())
    assert all(np.array_equal(read_back.matches.keypoints[photo], x) for photo, x in given.matches.keypoints.items())
    assert all(np.array_equal(read_back.views.fits[pair].F, fit.F) for pair, fit in given.views.fits.items())
    for pair, pose in part.graph.poses.items():
        read = found.graph.poses[pair]
        assert np.array_equal(read.R, pose.R) and np.array_equal(read.t, pose.t)
        assert np.array_equal(read.inliers, pose.inliers)
        assert (read.angle_deg, read.in_front, read.kind, read.guided) == (3.25, 0.9, "planar", sum(pair) % 2 == 0)
    assert read_back.intrinsics.to_dict() == given.intrinsics.to_dict()


def test_a_finished_part_is_read_with_its_false_joins(tmp_path):
    joins = LookAlikes(((1, 2), (3, 4)), 0.875), LookAlikes(((5, 6),), 0.5)
    result = {"models": ["model-0"], "mapper": "usual", "tried": [], "false_joins": [asdict(join) for join in joins]}
    (tmp_path / RESULT).write_text(json.dumps(result))
    found = map_part(Path(), tmp_path)
    assert found.false_joins == joins and found.models == (str(tmp_path / "model-0"),)
