"""Cuts, merges and loose scales of models."""

from itertools import combinations
from types import SimpleNamespace

import numpy as np
import pytest

from sfm_app.mapping.attempt import PairSupport
from sfm_app.mapping.splits import OPTIONS, sound_parts, weakly_joined_parts


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
