"""Finer features for unregistered photos; features and models are those of a test, databases and geometry are real."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sfm_app.api import open_run
from sfm_app.colmap.database import write_keypoints, write_matches
from sfm_app.colmap.model import posed_photo_ids
from sfm_app.errors import BackendError, ClusterError
from sfm_app.estimation import calibrating
from sfm_app.mapping import feature_retry
from sfm_app.mapping.attempt import Attempt, explained_pairs
from sfm_app.mapping.feature_retry import OPTIONS, add_matches, candidate_pairs, find_finer_evidence, lost_photos
from sfm_app.mapping.passes import Outcome
from sfm_app.plugins import FeatureMethod, load_plugins
from sfm_app.settings import Settings
from sfm_app.types import Evidence, MatchedImage, MatchGraph, ViewGraph
from tests.unit.mapping.fakes import EMPTY, hypothesis, without

LOST = 6


def attempt_of(synthetic, evidence, placed):
    """A model that holds the first so many photos."""
    model = without(synthetic.copy(), range(placed + 1, 7))
    explained = explained_pairs(model, evidence, 1.5)
    return Attempt("incremental", model, explained, f"{placed} photos")


@pytest.fixture
def first(synthetic, cameras, mapped, tmp_path):
    """Five of six photos placed; nothing is known of the matches of the last."""
    evidence = synthetic.evidence(cameras()).without([pair for pair in synthetic.matches.matches if LOST in pair])
    with open_run(tmp_path / "out", Settings.from_mapping({"workers": 1, "plugins": False}), None) as run:
        run.workspace.root.mkdir(parents=True)
        best = mapped.best(cameras(), run.with_fingerprint("these"), attempt_of(synthetic, evidence, 5))
        yield replace(best, evidence=evidence)


@pytest.fixture
def finer(synthetic, mapped, monkeypatch):
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

        mapped.mappers = replace(
            mapped.mappers,
            map_group=lambda group, _: [attempt_of(synthetic, group.evidence, places)],
            judge_places=lambda _: ([], 0),
        )
        monkeypatch.setattr(feature_retry, "fill_database", fill_database)
        return asked

    return make


@pytest.fixture
def retry(mapped):
    """Tries finer features after an outcome."""
    return lambda best: mapped.improve(best, hypothesis("finer-features"))


@pytest.mark.slow
def test_a_lost_photo_finds_its_place_by_finer_features(first, finer, retry):
    asked = finer()

    found = retry(first)

    assert asked == [("sift-affine", [(k, LOST) for k in range(1, LOST)], OPTIONS.max_ratio)]
    assert posed_photo_ids(found.main.model) == [1, 2, 3, 4, 5, 6]
    assert found.run.workspace.database != first.run.workspace.database
    assert found.calibrated is first.calibrated  # it was known
    assert len(found.evidence.views.fits) == 15
    trial = found.trials[-1]
    assert (trial.name, trial.accepted, trial.photos) == ("finer-features", True, (5, 6))
    assert [inner.name for inner in found.trials[:-1]] == ["finer-features: first-pass"]
    assert trial.reason == "1 photo is unregistered"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("missing", "chosen", "places", "used"),
    [
        ("", "sift", 5, ["sift-affine", "net"]),
        ("", "sift", 6, ["sift-affine"]),
        ("no torch", "sift", 5, ["sift-affine"]),
        ("", "sift-affine", 5, ["net"]),
        ("", "net", 5, ["sift-affine"]),
    ],
)
def test_features_of_a_plug_in_follow_while_a_photo_is_lost(first, finer, mapped, missing, chosen, places, used):
    asked, built_in = finer(places), load_plugins(installed=False)
    net = FeatureMethod("net", len, max, unavailable=lambda: missing)
    plugins = replace(built_in, features={**built_in.features, "net": net})
    run = replace(first.run, plugins=plugins, settings=Settings.from_mapping({"matching": {"features": chosen}}))
    mapped.improve(replace(first, run=run), hypothesis("finer-features"))
    assert [name for name, *_ in asked] == used


@pytest.mark.slow
def test_finer_features_add_matches_and_geometry(first, finer):
    finer()
    evidence, run = find_finer_evidence(first, first.run.plugins.feature_method("sift-affine"), first.run)
    assert evidence.intrinsics is first.calibrated and run.workspace.root != first.run.workspace.root
    views, rows = evidence.views, evidence.matches.matches
    assert all((k, LOST) in views.fits and len(rows[k, LOST]) >= 100 for k in range(1, LOST))
    assert all(views.fits[pair] is fit for pair, fit in first.evidence.views.fits.items())


@pytest.mark.slow
def test_cameras_that_were_not_known_are_found_anew(first, finer, cameras, monkeypatch):
    anew = cameras(focal=1200.0)
    finer()
    monkeypatch.setattr(calibrating, "find_intrinsics", lambda *_: anew)
    guessed = replace(first, calibrated=cameras(method="guess", identifiable=False))
    method = first.run.plugins.feature_method("sift-affine")
    assert find_finer_evidence(guessed, method, first.run)[0].intrinsics is anew


def is_unchanged(found, first):
    """Whether the best outcome is the first, and its only trial was rejected."""
    trial = found.trials[-1]
    return found.models is first.models and found.run is first.run and not trial.accepted


@pytest.mark.slow
def test_what_was_found_first_stays_where_no_more_photos_find_a_place(first, finer, retry):
    finer(places=5)
    found = retry(first)
    assert is_unchanged(found, first) and found.trials[-1].photos == (5, 5)


@pytest.mark.slow
def test_nothing_is_mapped_again_where_no_lost_photo_shows_the_same_scene(first, finer, retry):
    asked = finer(order=slice(None, None, -1))
    found = retry(first)
    assert is_unchanged(found, first) and len(asked) == 1
    assert (found.trials[-1].notes, found.trials[-1].failure) == ((), "")


@pytest.mark.slow
def test_finer_features_that_fail_cost_nothing(first, finer, retry):
    finer(failing=BackendError("the disk is full"))
    found = retry(first)
    assert is_unchanged(found, first) and found.trials[-1].failure == "the disk is full"


@pytest.mark.slow
def test_finer_features_whose_cluster_is_gone_are_not_skipped(first, finer, retry):
    finer(failing=ClusterError("the scheduler is gone"))
    with pytest.raises(ClusterError, match="scheduler"):
        retry(first)


@pytest.mark.slow
def test_no_finer_features_where_all_photos_have_a_place(first, finer, retry, synthetic):
    asked = finer()
    whole = replace(first, models=(attempt_of(synthetic, first.evidence, 6),))
    assert retry(whole) is whole and asked == []


@pytest.mark.slow
@pytest.mark.parametrize(
    "chosen", [{"scene": {"without": ["finer-features"]}}, {"matching": {"features": "sift-affine"}}]
)
def test_no_finer_features_where_they_are_not_wanted(first, finer, retry, chosen):
    asked = finer()
    unasked = replace(first, run=replace(first.run, settings=Settings.from_mapping(chosen)))
    assert retry(unasked) is unasked and asked == []


def photos(count, matches=()):
    images = {k: MatchedImage(k, f"{k:03d}.jpg", "one", 640, 480) for k in range(1, count + 1)}
    rows = {pair: np.zeros((number, 2), np.uint32) for pair, number in matches}
    return MatchGraph(images, {}, rows)


@pytest.mark.slow
def test_in_small_sets_a_lost_photo_is_matched_with_all_others():
    assert candidate_pairs([2], photos(4)) == [(1, 2), (2, 3), (2, 4)]


@pytest.mark.slow
def test_it_is_matched_with_its_neighbors_and_where_it_has_few_matches_with_more_in_order():
    graph = photos(100, [((50, k), 100 + k) for k in range(80, 100)] + [((10, 50), 500)])
    found = candidate_pairs([50], graph)
    near = {(48, 50), (49, 50), (50, 51), (50, 52)}
    likely = {(10, 50)} | {(50, k) for k in range(93, 100)}
    assert found == sorted(near | likely)
    unmatched = candidate_pairs([50], photos(100, [((10, 50), 500)]))
    assert unmatched == sorted({(10, 50)} | {(k, 50) for k in range(46, 50)} | {(50, k) for k in range(51, 54)})


@pytest.mark.parametrize(("count", "lost", "seen"), [(59, 1, 1), (100, 4, 0), (100, 5, 5)])
def test_few_lost_photos_of_many_are_left(count, lost, seen):
    images = {k: SimpleNamespace(image_id=k, has_pose=k <= count - lost) for k in range(1, count + 1)}
    models = (Attempt("incremental", SimpleNamespace(images=images), {}, ""),)
    best = Outcome(models, EMPTY, Evidence(photos(count), ViewGraph({}, {}), None), None, None)
    assert len(lost_photos(best)) == seen


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
