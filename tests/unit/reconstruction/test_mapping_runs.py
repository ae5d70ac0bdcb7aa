import threading
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from sfm_app.errors import BackendError
from sfm_app.mapping import attempt as module
from sfm_app.mapping.attempt import Attempt, Group, NoModel, PairSupport, best_attempt, choice_reason, map_group
from sfm_app.types import MatchedImage, MatchGraph, PoseGraph, RelativePose, ViewGraph

pytestmark = pytest.mark.slow


def model(photos, points=500):
    return SimpleNamespace(num_reg_images=lambda: photos, num_points3D=lambda: points)


def attempt(photos, support, points=500, mapper="incremental"):
    """One whose pairs are worth so much in all: each of them with 100 matches counts as 50."""
    explained = {(0, k): PairSupport(100, 100, 0) for k in range(support // 50)}
    left = support % 50
    if left:
        explained[0, -1] = PairSupport(round(left / (1 - left / 100)), 0, 0)
    return Attempt(mapper, model(photos, points), explained, "")


def test_the_attempt_that_explains_more_is_better_whatever_it_holds():
    more, most_photos = attempt(8, 1000, 100), attempt(10, 900, 9000)

    assert best_attempt([most_photos, more]) is more
    assert best_attempt([more, most_photos]) is more


def test_of_equal_ones_the_one_with_more_photos_and_then_with_more_points():
    fewer, denser, more = attempt(9, 10050, 900), attempt(9, 10000, 901), attempt(10, 10000, 10)

    assert best_attempt([fewer, denser]) is denser
    assert best_attempt([fewer, denser, more]) is more
    assert (
        best_attempt([attempt(9, 10000, 10, "global"), attempt(9, 10000, 10)]).mapper == "global"
    )  # the first of twins


def test_what_gave_no_model_is_never_better():
    nothing = NoModel("incremental", "")

    assert best_attempt([]) is None and best_attempt([nothing]) is None
    assert best_attempt([nothing, attempt(2, 0)]).photos == 2


COUNT = 10


@pytest.fixture
def try_out(run, cameras, monkeypatch):
    """What is tried on ten photos in a chain when mappers place so many photos; runs the two side by side.

    Seeds are the pairs (1, 2), (2, 3), ... in this order; `grown` says what becomes of each. A mapper that is `late`
    waits until the other one is done.
    """

    def make(
        grown, at_once=None, late="", count=COUNT, points=500, contradicted=0, completed=0, settled=False, **scene
    ):
        images = {key: MatchedImage(key, f"{key}.jpg", "one", 1024, 768) for key in range(1, count + 1)}
        rng = np.random.default_rng(0)
        keypoints = {key: rng.uniform((0, 0), (1024, 768), (400, 2)) for key in images}
        rows = np.tile(np.arange(400, dtype=np.uint32)[:, None], 2)
        poses = {
            (key, key + 1): RelativePose(np.eye(3), np.eye(3)[0], np.arange(400) < 400 - 20 * key, 20.0, 1.0)
            for key in range(1, count)
        }
        matches = MatchGraph(images, keypoints, dict.fromkeys(poses, rows))
        group = Group(tuple(images), matches, ViewGraph({}, {}), PoseGraph(poses, {}, ()), cameras())
        done, calls = {"global": threading.Event(), "incremental": threading.Event()}, []

        def finish(mapper, result):
            if mapper == late:
                assert done[{"global": "incremental", "incremental": "global"}[mapper]].wait(10)
            calls.append(mapper)
            done[mapper].set()
            return result

        def grow(database, photo_dir, start, scratch, options, tick, token):
            if not isinstance(start, tuple):  # what another mapper made
                return model(completed, points) if completed else None
            placed = grown[start[0] - 1] if start[0] <= len(grown) else 0
            if isinstance(placed, Exception):
                raise placed
            return finish("incremental", model(placed, points) if placed else None)

        def place(photo_dir, names, scratch, seed, token):
            assert list(names) == [f"{key}.jpg" for key in images]
            if isinstance(at_once, Exception):
                raise at_once
            return finish("global", model(at_once, points) if at_once else None)

        monkeypatch.setattr(module, "model_from_seed", lambda *arguments: arguments[1])
        monkeypatch.setattr(module, "map_incrementally", grow)
        monkeypatch.setattr(module, "map_globally", place)
        monkeypatch.setattr(module, "copy_database", lambda *_: None)
        explained = {(0, 1): PairSupport(100, 100, contradicted)}
        monkeypatch.setattr(module, "explained_pairs", lambda *_: explained)
        return map_group(group, run(**scene), lambda _: settled), calls

    return make


def placed(attempt):
    return 0 if isinstance(attempt, NoModel) else attempt.photos


def summary(found):
    return [(attempt.mapper, placed(attempt)) for attempt in found]


def test_both_mappers_are_tried_and_one_good_model_is_enough(try_out):
    found, _ = try_out([9, 10], at_once=3)

    assert summary(found) == [("incremental", 9), ("global", 3)]
    assert [attempt.note for attempt in found] == ["from 1.jpg + 2.jpg: 9 photos", "all at once: 3 photos"]
    assert found[0].support == 50 and found[0].model.num_reg_images() == 9


def test_where_it_is_easy_the_other_mapper_begins_only_if_it_is_needed(try_out, monkeypatch):
    monkeypatch.setattr(module, "_likely_needs_one_mapper", lambda _: True)

    found, calls = try_out([10], at_once=10)
    assert summary(found) == [("incremental", 10), ("global", 0)] and calls == ["incremental"]
    found, calls = try_out([9], at_once=10)
    assert summary(found) == [("incremental", 9), ("global", 10)] and calls == ["incremental", "global"]


@pytest.mark.parametrize(
    ("deviation", "dropped", "easy"), [(1.0, 0, True), (1.0, 5, True), (1.0, 6, False), (50.0, 0, False)]
)
def test_it_is_easy_with_known_cameras_and_few_contradictions(cameras, deviation, dropped, easy):
    images = {key: MatchedImage(key, f"{key}.jpg", "one", 1024, 768) for key in range(1, 102)}
    pose = RelativePose(np.eye(3), np.eye(3)[0], np.ones(40, np.bool_), 20.0, 1.0)
    pairs = [(key, key + 1) for key in range(1, 101)]
    graph = PoseGraph(dict.fromkeys(pairs[dropped:], pose), dict.fromkeys(pairs[:dropped], ""), ())
    known = cameras()
    sure = {name: replace(one, spread={"fx": deviation}) for name, one in known.cameras.items()}
    group = Group(tuple(images), MatchGraph(images, {}, {}), ViewGraph({}, {}), graph, replace(known, cameras=sure))

    assert module._likely_needs_one_mapper(group) is easy


@pytest.mark.parametrize("late", ["global", "incremental"])
def test_a_flawless_model_makes_the_other_one_needless_whether_or_not_it_is_there(try_out, late):
    found, _ = try_out([10], at_once=10 if late == "incremental" else None)

    assert summary(found) == [("incremental", 10), ("global", 0)]
    assert found[1].note == "all at once: not needed"


def test_a_model_of_all_photos_that_matches_contradict_is_not_flawless(try_out):
    assert summary(try_out([10], at_once=10, contradicted=2)[0]) == [("incremental", 10), ("global", 10)]
    assert summary(try_out([10], at_once=10, contradicted=1)[0]) == [("incremental", 10), ("global", 0)]


def test_a_contradicted_model_that_says_enough_makes_the_other_one_needless(try_out):
    found, _ = try_out([10], at_once=10, contradicted=2, settled=True)

    assert summary(found) == [("incremental", 10), ("global", 0)]
    assert found[1].note == "all at once: not needed"


def test_why_a_model_was_taken_is_said():
    best, rival, nothing = attempt(10, 1000), attempt(9, 900), NoModel("global", "")
    contradicted = Attempt("global", model(10), {(0, 1): PairSupport(90, 100, 10)}, "")

    assert choice_reason(best, [best, nothing], 10) == "it registers all 10 photos, and almost no match contradicts it"
    assert choice_reason(contradicted, [contradicted, nothing], 10) == "no other attempt gave a model"
    assert choice_reason(contradicted, [contradicted], 10) == "it explains enough; no other model was needed"
    assert (
        choice_reason(best, [rival, best], 11) == "it explains 2000 matches with 10 photos, the second best 1800 with 9"
    )


def test_a_global_mapper_that_fails_leaves_the_other_model(try_out):
    found, _ = try_out([9], at_once=BackendError("bad day"))

    assert summary(found) == [("incremental", 9), ("global", 0)]
    assert found[1].note == "all at once: failed, bad day"


@pytest.mark.parametrize(
    ("grown", "at_once", "counts"),
    [
        ([10, 3], 2, [10, 0]),  # nothing better can come
        ([2, 3], 9, [2, 9, 0]),  # nor after the other mapper
        ([0, 0, 9], 0, [0, 0, 0, 9]),  # what fails is followed by the next best
        ([3, 3, 7, 2, 2], 3, [3, 3, 3, 7, 2, 2]),  # few photos, several times the same, are no reason to stop
        ([6, 9], 6, [6, 6]),  # more than half, twice the same: the others hang loose
        ([5, 4, 5, 9], 2, [5, 2, 4, 5]),  # also with another between them
        ([0, 0, 0, 0, 0, 10], 0, [0, 0, 0, 0, 0, 0]),  # no more seeds than allowed
    ],
)
def test_seeds_are_tried_until_one_grows(try_out, grown, at_once, counts):
    found, _ = try_out(grown, at_once, max_init_pairs=5)

    assert [placed(attempt) for attempt in found] == counts


@pytest.mark.parametrize("late", ["global", "incremental"])
def test_it_does_not_matter_which_mapper_is_done_first(try_out, late):
    found, calls = try_out([4, 7, 7, 7], at_once=4, late=late)

    assert calls[:2] == (["incremental", "global"] if late == "global" else ["global", "incremental"])
    assert summary(found) == [("incremental", 4), ("global", 4), ("incremental", 7), ("incremental", 7)]


def test_one_mapper_alone(try_out):
    assert summary(try_out([5, 10], at_once=10, mapper="incremental")[0]) == [("incremental", 5), ("incremental", 10)]
    assert summary(try_out([5, 10], at_once=10, mapper="global")[0]) == [("global", 10)]


def test_photos_that_the_global_mapper_left_out_get_a_second_chance(try_out):
    found, _ = try_out([3], at_once=8, completed=10, max_init_pairs=1)

    assert summary(found) == [("incremental", 3), ("global", 8), ("incremental", 10)]
    assert found[2].note == "missing photos added one by one: 10 photos"


def test_of_two_photos_positions_have_no_scale_to_agree_on(try_out):
    assert summary(try_out([2], at_once=2, count=2)[0]) == [("incremental", 2)]
    assert summary(try_out([2], at_once=2, count=2, mapper="global")[0]) == [("incremental", 2)]


def test_without_seeds_all_photos_can_still_be_placed_at_once(try_out):
    found, _ = try_out([10], at_once=10, min_seed_angle_deg=25.0)

    assert summary(found) == [("global", 10)]
    assert try_out([10], min_seed_angle_deg=25.0, mapper="incremental")[0] == []


def test_a_model_with_too_few_points_is_none(try_out):
    found, _ = try_out([10], at_once=10, points=29)

    assert all(isinstance(attempt, NoModel) for attempt in found)
    assert [attempt.note for attempt in found[:2]] == ["from 1.jpg + 2.jpg: 10 photos", "all at once: 10 photos"]
    assert len(try_out([10], at_once=10, points=30)[0]) == 2


def test_an_error_of_a_mapper_says_what_was_being_done(try_out):
    with pytest.raises(BackendError, match="mapping photos: out of luck"):
        try_out([ValueError("out of luck")], at_once=2)
