"""Cuts, merges and loose scales of models."""

from dataclasses import replace
from itertools import combinations
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sfm_app.colmap.model import move, posed_photo_ids, poses_and_points, submodel
from sfm_app.geometry.poses import Similarity, umeyama
from sfm_app.mapping.attempt import PairSupport, judge_model
from sfm_app.mapping.split_and_merge import OPTIONS, merge_into_main, shared_points, sound_parts, weakly_joined_parts
from sfm_app.types import ViewGraph
from tests.unit.mapping.fakes import geometries_in, hypothesis, trials_of


def explained_pairs_of(worths):
    """By pair: matches that the model explains, less those that it contradicts."""
    return {
        pair: PairSupport(worth + 50, 50, 50) if worth > 0 else PairSupport(10, 10 - worth, 10 - worth)
        for pair, worth in worths.items()
    }


def parts(worths, photos):
    return sound_parts(explained_pairs_of(worths), photos)


LEFT, RIGHT = dict.fromkeys(combinations((1, 2, 3, 4), 2), 200), dict.fromkeys(combinations((5, 6, 7), 2), 150)


def test_a_chain_holds_together_by_its_neighbors():
    assert parts({(1, 2): 20, (2, 3): 300, (3, 4): 16, (4, 5): 50}, range(1, 6)) == [(1, 2, 3, 4, 5)]


def test_a_join_that_many_matches_contradict_is_cut():
    contradictions = {(3, 6): -40, (2, 5): -40}
    assert parts(LEFT | RIGHT | {(4, 5): 60} | contradictions, range(1, 8)) == [(1, 2, 3, 4), (5, 6, 7)]


def test_a_join_that_outweighs_what_contradicts_it_holds():
    assert parts(LEFT | RIGHT | {(4, 5): 60, (3, 6): 30, (2, 5): -40, (1, 6): -40}, range(1, 8)) == [tuple(range(1, 8))]


def test_a_handful_of_matches_neither_joins_nor_cuts():
    few = dict.fromkeys([(1, 5), (1, 6), (2, 5), (2, 6), (3, 5)], 15)
    assert parts(LEFT | RIGHT | few, range(1, 8)) == [(1, 2, 3, 4), (5, 6, 7)]
    assert parts(LEFT | RIGHT | {(4, 5): 16} | dict.fromkeys(few, -15), range(1, 8)) == [tuple(range(1, 8))]


def test_a_photo_that_no_pair_holds_stays_alone():
    assert parts(LEFT | {(4, 9): 15}, [1, 2, 3, 4, 8, 9]) == [(1, 2, 3, 4), (8,), (9,)]


def test_parts_of_one_size_are_in_the_order_of_their_photos():
    assert parts({(4, 5): 100, (1, 2): 50}, [1, 2, 4, 5]) == [(1, 2), (4, 5)]


@pytest.mark.parametrize("seed", range(6))
def test_the_order_in_which_pairs_come_does_not_matter(seed):
    rng = np.random.default_rng(seed)
    worths = {pair: int(rng.integers(-60, 90)) for pair in combinations(range(9), 2) if rng.random() < 0.6}
    names = list(worths)
    shuffled = {names[k]: worths[names[k]] for k in rng.permutation(len(names))}
    found = parts(worths, range(9))
    assert found == parts(shuffled, reversed(range(9)))
    assert sorted(photo for part in found for photo in part) == list(range(9))
    assert found == sorted(found, key=lambda part: (-len(part), part))


ELSEWHERE = Similarity(3.7, Rotation.from_rotvec([0.4, -1.1, 2.0]).as_matrix(), np.array([5.0, -2.0, 11.0]))


@pytest.fixture
def halves(synthetic, run):
    """Photos 1 to 3, and 4 to 6 elsewhere."""
    first, second = submodel(synthetic.model, (1, 2, 3)), submodel(synthetic.model, (4, 5, 6))
    move(second, ELSEWHERE)
    return tuple(judge_model(synthetic.evidence(), "incremental", "half", model, run()) for model in (first, second))


def within(pair):
    """Whether both photos are of one half."""
    return (pair[0] <= 3) == (pair[1] <= 3)


def centers(model):
    return np.array([-pose[:, :3].T @ pose[:, 3] for pose in poses_and_points(model)[0].values()])


@pytest.mark.slow
def test_points_that_both_know_are_found_once_with_both_their_places(synthetic, halves):
    shared = shared_points(halves[0].model, halves[1].model, synthetic.matches, synthetic.views)
    assert 50 < len(shared) <= halves[0].model.num_points3D()
    assert np.allclose(ELSEWHERE(shared[:, :3]), shared[:, 3:], atol=0.2)


@pytest.mark.slow
def test_halves_become_one_model_as_exact_as_the_whole(synthetic, halves, run):
    (found,) = merge_into_main(halves, synthetic.evidence(), run())
    assert posed_photo_ids(found.model) == [1, 2, 3, 4, 5, 6]
    assert found.note.startswith("3 and 3 photos joined by ")
    true, got = centers(synthetic.model), centers(found.model)
    size = np.linalg.norm(true - true.mean(axis=0), axis=1).max()
    assert np.linalg.norm(umeyama(got, true)(got) - true, axis=1).max() < 0.005 * size
    assert 0.05 < found.model.compute_mean_reprojection_error() < 0.5


@pytest.mark.slow
def test_what_shares_too_few_points_stays_apart(synthetic, halves, run):
    views = ViewGraph({pair: fit for pair, fit in synthetic.views.fits.items() if within(pair)}, {})
    assert len(shared_points(halves[0].model, halves[1].model, synthetic.matches, views)) < OPTIONS.min_shared
    assert merge_into_main(halves, replace(synthetic.evidence(), views=views), run()) == halves


@pytest.mark.slow
def test_matches_that_disagree_about_the_place_join_nothing(synthetic, halves, run):
    rng = np.random.default_rng(1)
    rows = {
        pair: row if within(pair) else np.column_stack([row[:, 0], rng.permutation(row[:, 1])])
        for pair, row in synthetic.matches.matches.items()
    }
    matches = replace(synthetic.matches, matches=rows)
    assert merge_into_main(halves, replace(synthetic.evidence(), matches=matches), run()) == halves


@pytest.mark.slow
def test_models_that_mapping_left_apart_are_joined_in_the_end(halves, run, cameras, mapped):
    found = mapped.improve(mapped.best(cameras(), run(), *halves), hypothesis("merged-models"))
    assert [model.photos for model in found.models] == [6]
    assert found.reason == found.models[0].note
    assert trials_of(found) == [("merged-models", True, found.reason)]
    assert len(found.graph.poses) == len(geometries_in(run().workspace.database)) == 15


@pytest.mark.slow
def test_models_that_share_too_little_are_tried_and_stay_apart(synthetic, halves, run, cameras, mapped):
    views = ViewGraph({pair: fit for pair, fit in synthetic.views.fits.items() if within(pair)}, {})
    best = mapped.best(cameras(), run(), *halves)
    best = replace(best, evidence=replace(best.evidence, views=views))
    found = mapped.improve(best, hypothesis("merged-models"))
    assert found.models == halves and trials_of(found) == [("merged-models", False)]


def model(*tracks):
    """A model of photos 1 to 6, or those that its points are seen by: (photos, how many such points)."""

    def point(photos):
        return SimpleNamespace(track=SimpleNamespace(elements=[SimpleNamespace(image_id=photo) for photo in photos]))

    points = [point(photos) for photos, count in tracks for _ in range(count)]
    placed = {photo for photos, _ in tracks for photo in photos}
    images = {
        photo: SimpleNamespace(image_id=photo, name=f"{photo}.jpg", has_pose=photo in placed) for photo in range(1, 8)
    }
    return SimpleNamespace(images=images, points3D=dict(enumerate(points)))


@pytest.mark.slow
def test_photos_that_see_what_two_others_see_are_well_joined():
    assert weakly_joined_parts(model(((1, 2, 3), 40), ((2, 3, 4), 40), ((3, 4, 5), OPTIONS.min_common_points))) == []


@pytest.mark.slow
def test_parts_that_share_hardly_a_point_of_three_photos_are_named():
    tracks = ((1, 2, 3), 40), ((3, 4), 200), ((2, 3, 4), OPTIONS.min_common_points - 1), ((4, 5, 6), 30)
    # 4 hangs on four points, and 5 and 6 on photo 4 alone
    assert weakly_joined_parts(model(*tracks)) == [["1.jpg", "2.jpg"], ["5.jpg", "6.jpg"]]


@pytest.mark.slow
def test_a_chain_of_pairs_has_no_scale_at_all():
    assert weakly_joined_parts(model(((1, 2), 50), ((2, 3), 40), ((3, 4), 30))) == [["3.jpg"], ["4.jpg"]]


@pytest.mark.slow
def test_two_photos_and_none_have_nothing_to_be_joined_to():
    assert weakly_joined_parts(model(((1, 2), 50))) == [] and weakly_joined_parts(model()) == []
