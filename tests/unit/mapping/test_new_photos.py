"""New photos in an earlier model: COLMAP's mapper places them, and a stand-in maps all again."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from sfm_app.colmap.database import write_match_graph
from sfm_app.colmap.model import posed_photo_ids, submodel
from sfm_app.mapping import new_photos
from sfm_app.mapping.attempt import Attempt, explained_pairs, model_poses
from sfm_app.mapping.new_photos import map_new_photos
from sfm_app.mapping.passes import Mappers, Outcome, Trial
from sfm_app.posegraph import PoseGraphOptions, build_pose_graph
from sfm_app.types import LookAlikes, RelativePose
from tests.unit.mapping.fakes import EMPTY, trials_of

pytestmark = pytest.mark.slow


@pytest.fixture
def grow(synthetic, cameras, run, tmp_path, monkeypatch):
    """Maps with an earlier model of some photos; the whole set would be mapped as the given model."""

    def make(model, known, whole=None, judge_places=None, **steps):
        place = SimpleNamespace(database=tmp_path / "earlier.db", sparse=tmp_path / "earlier")
        place.sparse.mkdir()
        (tmp_path / "photos").mkdir()  # COLMAP requires it
        model.write(place.sparse)
        write_match_graph(place.database, synthetic.matches)
        names = frozenset(synthetic.matches.images[photo].name for photo in known)
        figures, context = {}, run(min_points=10, without=["finer-features"])
        context.record = lambda **more: figures.update(more)
        found = cameras()

        def reconstruct(evidence, run, *, hypotheses):
            models = ()
            if whole:
                explained = explained_pairs(whole, evidence, 1.5)
                models = (Attempt("incremental", whole, explained, "all again"),)
            trial = Trial("first-pass", "", True, (0, 6), (0.0, 9.0), 1.0, ("all again",))
            return Outcome(models, EMPTY, evidence, evidence.intrinsics, run, trials=(trial,))

        earlier = SimpleNamespace(place=place, known=names)
        if judge_places:
            steps["MAPPERS"] = Mappers(judge_places=judge_places)
        for name, fake in {"find_cameras": lambda *_: found, "reconstruct": reconstruct, **steps}.items():
            monkeypatch.setattr(new_photos, name, fake)
        return map_new_photos(synthetic.evidence(found), context, earlier), figures

    return make


def test_new_photos_join_the_model_and_nothing_is_mapped_again(grow, synthetic):
    found, figures = grow(submodel(synthetic.model, [1, 2, 3, 4]), (1, 2, 3, 4))
    main = found.models[0]
    assert posed_photo_ids(main.model) == [1, 2, 3, 4, 5, 6]
    assert main.mapper == "grown" and figures["mapped_again_because"] == "" and figures["grown_from"] == 4
    assert sum(pair.matches for pair in main.explained.values()) > 0.95 * 15 * 100
    poses = {photo: main.model.images[photo].cam_from_world().rotation.matrix() for photo in (1, 6)}
    true = {photo: synthetic.model.images[photo].cam_from_world().rotation.matrix() for photo in (1, 6)}
    turn = poses[6] @ poses[1].T @ (true[6] @ true[1].T).T
    assert np.degrees(np.arccos((np.trace(turn) - 1) / 2)) < 0.5


def test_photos_that_left_leave_the_model(grow, synthetic):
    found, figures = grow(synthetic.copy(), (1, 2, 3, 4, 5))
    assert figures["mapped_again_because"] == ""
    assert len(posed_photo_ids(found.models[0].model)) == 6  # the sixth was replaced, and is placed anew


def test_a_known_photo_whose_pairs_were_dropped_leaves_and_keeps_no_other_from_its_place(grow, synthetic):
    build = build_pose_graph

    def without_the_first(*inputs):
        graph = build(*inputs)
        poses = {pair: pose for pair, pose in graph.poses.items() if 1 not in pair}
        return replace(graph, poses=poses, groups=((2, 3, 4, 5, 6),))

    found, _ = grow(
        submodel(synthetic.model, [1, 2, 3, 4]),
        (1, 2, 3, 4),
        whole=submodel(synthetic.model, [1, 2]),
        build_pose_graph=without_the_first,
    )

    assert posed_photo_ids(found.models[0].model) == [2, 3, 4, 5, 6]
    assert found.reason == "3 photos were known, and 2 of 2 others were registered"


def test_a_wrong_earlier_model_is_mapped_again(grow, synthetic):
    wrong = submodel(synthetic.model, [1, 2, 3, 4])
    for photo, other in ((1, 2), (3, 4)):
        frames = [wrong.frames[wrong.images[key].frame_id] for key in (photo, other)]
        poses = [frame.rig_from_world for frame in frames]
        frames[0].rig_from_world, frames[1].rig_from_world = poses[1], poses[0]
    found, figures = grow(wrong, (1, 2, 3, 4), whole=synthetic.copy())
    assert figures["mapped_again_because"]
    assert found.models[0].note == "all again"


def test_a_model_of_few_of_the_photos_is_no_start(grow, synthetic):
    found, figures = grow(submodel(synthetic.model, [1, 2]), (1, 2), whole=synthetic.copy())
    assert "only 2 of 6 photos" in figures["mapped_again_because"]
    assert found.models[0].photos == 6


def test_the_grown_model_stays_where_all_again_explains_less(grow, synthetic):
    found, figures = grow(
        submodel(synthetic.model, [1, 2, 3, 4]),
        (1, 2, 3, 4),
        whole=submodel(synthetic.model, [1, 2, 3]),
        doubt=lambda *_: "a doubt",
    )
    assert figures["mapped_again_because"] == "a doubt"
    assert found.models[0].mapper == "grown" and found.models[0].photos == 6
    assert trials_of(found) == [("mapped-anew: first-pass", True, "all again"), ("mapped-anew", False)]


@pytest.mark.parametrize(("anew", "mapper"), [([], "incremental"), (None, "grown")])
def test_a_grown_model_with_two_places_in_one_stays_only_where_nothing_else_is_found(grow, synthetic, anew, mapper):
    join = LookAlikes(((1, 6),), 0.9)
    found, figures = grow(
        submodel(synthetic.model, [1, 2, 3, 4]),
        (1, 2, 3, 4),
        whole=None if anew is None else synthetic.copy(),
        judge_places=lambda models: ([join], 12) if models[:1] and models[0].mapper == "grown" else ([], 0),
    )
    assert figures["mapped_again_because"] == "two different places are merged in the model"
    assert found.models[0].mapper == mapper
    assert found.graph.doubtful == (() if mapper == "incremental" else (join,))


def test_known_pairs_are_not_estimated_again(synthetic, cameras):
    known = model_poses(submodel(synthetic.model, [1, 2, 3, 4]), synthetic.matches, 1.5, 16)
    asked = []

    def run_map(function, items, label):
        asked.append((label, list(items)))
        return [function(item) for item in items]

    graph = build_pose_graph(synthetic.evidence(cameras()), PoseGraphOptions(1.5, 16, 0), run_map, known)

    assert len(known) == 6 and all(graph.poses[pair] is pose for pair, pose in known.items())
    assert [pair for pair, _ in asked[0][1]] == [pair for pair in synthetic.views.fits if pair not in known]
    assert len(graph.poses) == 15


def test_a_known_pose_that_the_others_contradict_is_dropped(synthetic, cameras):
    poses = model_poses(synthetic.model, synthetic.matches, 1.5, 16)
    known = {pair: pose for pair, pose in poses.items() if 6 not in pair}
    quarter = np.array([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]])
    known[1, 2] = replace(known[1, 2], R=quarter @ known[1, 2].R)
    assert isinstance(known[1, 2], RelativePose)

    graph = build_pose_graph(
        synthetic.evidence(cameras()), PoseGraphOptions(1.5, 16, 0),
        lambda function, items, _: [function(item) for item in items], known,
    )  # fmt: skip

    assert (1, 2) not in graph.poses and len(graph.poses) == 14
