"""The second look, with features and mappers that find what the test says; databases and geometries are real."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sfm_app.api import open_run
from sfm_app.colmap.database import write_keypoints, write_matches
from sfm_app.colmap.model import posed_photo_ids
from sfm_app.errors import BackendError, ClusterError
from sfm_app.mapping import feature_retry as module
from sfm_app.mapping.attempt import Attempt, explained_pairs
from sfm_app.mapping.feature_retry import (
    OPTIONS,
    MappedScene,
    Steps,
    add_matches,
    candidate_pairs,
    lost_photos,
    retry_lost_photos,
)
from sfm_app.mapping.passes import Outcome
from sfm_app.settings import Settings
from sfm_app.types import MatchedImage, MatchGraph, PoseGraph, ViewGraph

LOST = 6


def outcome_of(synthetic, matches, views, placed):
    """A model that holds the first so many photos."""
    model = synthetic.copy()
    for photo in range(placed + 1, 7):
        model.deregister_frame(model.images[photo].frame_id)
    attempt = Attempt("incremental", model, explained_pairs(model, matches, views, 1.5), f"{placed} photos")
    return Outcome((attempt,), PoseGraph({}, {}, ()), None, ())


@pytest.fixture
def first(synthetic, cameras, tmp_path):
    """Five of six photos placed; nothing is known of the matches of the last."""
    matches = replace(
        synthetic.matches, matches={pair: rows for pair, rows in synthetic.matches.matches.items() if LOST not in pair}
    )
    views = ViewGraph({pair: fit for pair, fit in synthetic.views.fits.items() if LOST not in pair}, {})
    with open_run(tmp_path / "out", Settings.from_mapping({"workers": 1}), None) as run:
        run.workspace.root.mkdir(parents=True)
        yield MappedScene(
            outcome_of(synthetic, matches, views, 5), matches, views, cameras(), run.with_fingerprint("these")
        )


@pytest.fixture
def finer(synthetic):
    """Lets finer features be those that COLMAP has made; what is asked for is noted. `places` of six find a place.

    Matches are wrong where their second features come in another `order`.
    """

    def make(places=6, failing=None, order=slice(None)):
        asked = []

        def fill_database(method, run, pairs):
            asked.append((method.name, pairs, run.settings.matching.max_ratio))
            if failing:
                raise failing
            for photo in sorted({photo for pair in pairs for photo in pair}):
                write_keypoints(run.workspace.database, photo, synthetic.matches.keypoints[photo].astype(np.float32))
            for pair in pairs:
                rows = synthetic.matches.matches[pair]
                write_matches(run.workspace.database, pair, np.stack([rows[:, 0], rows[order, 1]], axis=1))

        def reconstruct(matches, views, intrinsics, run):
            asked.append((matches, views, intrinsics))
            return outcome_of(synthetic, matches, views, places)

        return asked, Steps(fill_database, reconstruct=reconstruct)

    return make


@pytest.mark.slow
def test_a_lost_photo_finds_its_place_by_finer_features(first, finer):
    asked, steps = finer()

    found = retry_lost_photos(first, steps)

    assert asked[0] == ("sift-dsp", [(k, LOST) for k in range(1, LOST)], OPTIONS.max_ratio)
    matches, views, intrinsics = asked[1]
    assert intrinsics is first.intrinsics  # it was known
    assert all((k, LOST) in views.fits and len(matches.matches[k, LOST]) >= 100 for k in range(1, LOST))
    assert all(views.fits[pair] is fit for pair, fit in first.views.fits.items())
    assert posed_photo_ids(found.outcome.models[0].model) == [1, 2, 3, 4, 5, 6]
    assert found.run.workspace.database != first.run.workspace.database
    said = first.run.statistics["second_look"]
    assert (said["placed"], said["taken"], said["pairs_with_geometry"]) == ([5, 6], True, [10, 15])


@pytest.mark.slow
def test_cameras_that_were_not_known_are_found_anew(first, finer, cameras):
    (asked, steps), anew = finer(), cameras(focal=1200.0)
    steps = replace(steps, find_intrinsics=lambda *_: (anew, ()))
    retry_lost_photos(replace(first, intrinsics=cameras(method="guess", identifiable=False)), steps)
    assert asked[1][2] is anew


@pytest.mark.slow
def test_what_was_found_first_stays_where_no_more_photos_find_a_place(first, finer):
    _, steps = finer(places=5)
    assert retry_lost_photos(first, steps) is first
    assert first.run.statistics["second_look"]["taken"] is False


@pytest.mark.slow
def test_nothing_is_mapped_again_where_no_lost_photo_shows_the_same_scene(first, finer):
    asked, steps = finer(order=slice(None, None, -1))
    assert retry_lost_photos(first, steps) is first
    assert len(asked) == 1
    assert (first.run.statistics["second_look"]["placed"], first.run.statistics["second_look"]["taken"]) == ([5], False)


@pytest.mark.slow
def test_a_second_look_that_fails_costs_nothing(first, finer):
    _, steps = finer(failing=BackendError("the disk is full"))
    assert retry_lost_photos(first, steps) is first
    assert first.run.statistics["second_look"]["failed"] == "the disk is full"


@pytest.mark.slow
def test_a_second_look_whose_cluster_is_gone_is_not_skipped(first, finer):
    _, steps = finer(failing=ClusterError("the scheduler is gone"))
    with pytest.raises(ClusterError, match="scheduler"):
        retry_lost_photos(first, steps)


@pytest.mark.slow
def test_nobody_looks_twice_where_all_photos_have_a_place(first, finer, synthetic):
    asked, steps = finer()
    whole = replace(first, outcome=outcome_of(synthetic, first.matches, first.views, 6))
    assert retry_lost_photos(whole, steps) is whole and asked == [] and "second_look" not in first.run.statistics


@pytest.mark.slow
@pytest.mark.parametrize("chosen", [{"scene": {"second_look": False}}, {"matching": {"features": "sift-dsp"}}])
def test_nobody_looks_twice_where_that_is_not_wanted(first, finer, chosen):
    asked, steps = finer()
    unasked = replace(first, run=replace(first.run, settings=Settings.from_mapping(chosen)))
    assert retry_lost_photos(unasked, steps) is unasked and asked == []


def photos(count, matches=()):
    images = {k: MatchedImage(k, f"{k:03d}.jpg", "one", 640, 480) for k in range(1, count + 1)}
    rows = {pair: np.zeros((number, 2), np.uint32) for pair, number in matches}
    return MatchGraph(images, {}, rows)


@pytest.mark.slow
def test_in_small_sets_a_lost_photo_is_matched_with_all_others():
    assert candidate_pairs([2], photos(4)) == [(1, 2), (2, 3), (2, 4)]


@pytest.mark.slow
def test_in_large_sets_it_is_matched_with_its_neighbors():
    graph = photos(100, [((50, k), 100 + k) for k in range(80, 100)] + [((10, 50), 500)])
    found = candidate_pairs([50], graph)
    near = {(48, 50), (49, 50), (50, 51), (50, 52)}
    likely = {(10, 50)} | {(50, k) for k in range(93, 100)}
    assert found == sorted(near | likely)


@pytest.mark.slow
@pytest.mark.parametrize(("count", "lost", "seen"), [(59, 1, 1), (100, 4, 0), (100, 5, 5)])
def test_few_lost_photos_of_many_are_left(monkeypatch, count, lost, seen):
    monkeypatch.setattr(module, "posed_photo_ids", lambda _: range(1, count - lost + 1))
    outcome = Outcome((Attempt("incremental", object(), {}, ""),), PoseGraph({}, {}, ()), None, ())
    assert len(lost_photos(MappedScene(outcome, photos(count), ViewGraph({}, {}), None, None))) == seen


GRID = np.array([[10.0 * k, 5.0] for k in range(4)])


def graph(known=()):
    rows = {(1, 2): np.array(known, np.uint32)} if len(known) else {}
    return MatchGraph({}, {1: GRID, 2: GRID + 1.0, 3: np.zeros((0, 2))}, rows)


def test_keypoints_in_one_place_are_one_and_others_are_appended():
    found = {1: np.array([[10.3, 5.0], [14.0, 5.0]]), 2: np.array([[1.0, 6.0], [90.0, 9.0]])}
    merged, changed = add_matches(graph(known=[[0, 3]]), found, {(1, 2): np.array([[0, 0], [1, 1]], np.uint32)})
    np.testing.assert_array_equal(merged.keypoints[1], np.vstack([GRID, found[1]]))
    np.testing.assert_array_equal(merged.matches[1, 2], [[0, 3], [1, 0], [5, 5]])
    assert changed == ((1, 2),)


def test_a_keypoint_that_has_a_match_gets_no_other():
    found = {1: GRID, 2: GRID + 1.0}
    merged, changed = add_matches(graph(known=[[0, 3]]), found, {(1, 2): np.array([[0, 1], [2, 3]], np.uint32)})
    np.testing.assert_array_equal(merged.matches[1, 2], [[0, 3]])
    assert changed == ()


def test_a_pair_and_a_photo_without_anything_get_what_was_found():
    found = {1: GRID, 3: GRID}
    merged, changed = add_matches(graph(), found, {(1, 3): np.array([[3, 1]], np.uint32)})
    np.testing.assert_array_equal(merged.matches[1, 3], [[3, 1]])
    assert changed == ((1, 3),) and len(merged.keypoints[3]) == 4


@given(st.integers(0, 2**32 - 1))
def test_matches_stay_one_to_one_and_lie_where_they_were_found(seed):
    rng = np.random.default_rng(seed)
    known = np.column_stack([rng.permutation(4)[:2], rng.permutation(4)[:2]])
    found = {photo: rng.uniform(0, 40, (6, 2)) for photo in (1, 2)}
    found[1][:2] = GRID[:2] + 0.2
    added = np.column_stack([rng.permutation(6), rng.permutation(6)]).astype(np.uint32)

    merged, _ = add_matches(graph(known=known), found, {(1, 2): added})
    rows = merged.matches[1, 2]

    np.testing.assert_array_equal(rows[:2], known)
    assert all(len(np.unique(column)) == len(rows) for column in rows.T)
    every = np.hstack([found[1][added[:, 0]], found[2][added[:, 1]]])
    for row in np.hstack(merged.points((1, 2)))[2:]:
        assert np.abs(every - row).max(axis=1).min() <= 0.5
