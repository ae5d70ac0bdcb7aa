from itertools import combinations

import numpy as np
import pytest

from sfm_app.mapping.attempt import PairSupport
from sfm_app.mapping.split_and_merge import sound_parts


def explained(worths):
    """By pair: matches that the model explains, less those that it contradicts."""
    return {
        pair: PairSupport(worth + 50, 50, 50) if worth > 0 else PairSupport(10, 10 - worth, 10 - worth)
        for pair, worth in worths.items()
    }


def parts(worths, photos):
    return sound_parts(explained(worths), photos)


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


@pytest.mark.parametrize("seed", range(20))
def test_the_order_in_which_pairs_come_does_not_matter(seed):
    rng = np.random.default_rng(seed)
    worths = {pair: int(rng.integers(-60, 90)) for pair in combinations(range(9), 2) if rng.random() < 0.6}
    names = list(worths)
    shuffled = {names[k]: worths[names[k]] for k in rng.permutation(len(names))}

    found = parts(worths, range(9))

    assert found == parts(shuffled, reversed(range(9)))
    assert sorted(photo for part in found for photo in part) == list(range(9))
    assert found == sorted(found, key=lambda part: (-len(part), part))
