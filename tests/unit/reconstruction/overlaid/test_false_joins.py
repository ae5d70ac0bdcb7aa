"""Pairs that hold one place on top of another."""

import numpy as np
import pytest

from sfm_app.mapping.attempt import Attempt, PairSupport
from sfm_app.mapping.look_alikes import OVERLAPS, ExpectedOverlap, find_false_joins, find_non_overlapping, judge_places

pytestmark = pytest.mark.slow


def two_streets(walls, length=24, alike=(10.0, 14.0)):
    """Two walks along different walls in one place; both see the same house in the middle."""
    low, high = alike
    house = walls.add_points(low, high, seed=0)
    for first, seed in ((1, 1), (101, 2)):
        own = np.concatenate([walls.add_points(0, low, seed), walls.add_points(high, length, seed + 10)])
        places = np.arange(3, length - 3, 0.5)
        walls.add_walk(range(first, first + len(places)), places, np.concatenate([own, house]))
    return walls.finish()


def test_a_house_in_two_streets_is_found_and_nothing_else(walls):
    model, explained = two_streets(walls)

    joins, non_overlapping = judge_places([Attempt("incremental", model, explained, "")])

    across = {pair for pair, found in explained.items() if pair[0] < 100 < pair[1] and found.matches >= 16}
    assert len(joins) == 1
    assert set(joins[0].pairs) == across
    assert 0.5 < joins[0].missing < 1.0
    assert non_overlapping >= 40


def test_one_street_that_is_walked_twice_is_no_false_join(walls):
    wall = walls.add_points(0, 24, seed=1)
    places = np.arange(3, 21, 0.5)
    walls.add_walk(range(1, 1 + len(places)), places, wall)
    walls.add_walk(range(101, 101 + len(places)), places + 0.2, wall, shift=0.3)
    model, explained = walls.finish()

    assert judge_places([Attempt("incremental", model, explained, "")]) == ([], 0)


def test_a_loop_whose_ends_were_hardly_matched_stays():
    """A quarter of the photos that should share much share nothing: matching failed, the rest bears the loop out."""
    explained = {(a, 100 + b): PairSupport(200, 200, 0) for a in range(12) for b in range(12) if (a + b) % 4}
    explained |= {(a + side, a + 1 + side): PairSupport(500, 500, 0) for a in range(11) for side in (0, 100)}
    overlaps = {(a, 100 + b): ExpectedOverlap(60, 0 if (a + b) % 4 == 0 else 50) for a in range(12) for b in range(12)}
    beside = [(a + side, b + side) for a in range(12) for b in range(a + 1, min(a + 5, 12)) for side in (0, 100)]
    overlaps |= dict.fromkeys(beside, ExpectedOverlap(60, 58))

    assert len(find_non_overlapping(overlaps, explained)) >= OVERLAPS.min_pairs
    assert find_false_joins(overlaps, explained) == []


def test_photos_whose_matches_hold_are_no_strangers():
    overlaps = {(1, 2): ExpectedOverlap(50, 0), (1, 3): ExpectedOverlap(50, 0), (2, 3): ExpectedOverlap(50, 20)}

    found = find_non_overlapping(overlaps, {(1, 2): PairSupport(40, 40, 0), (1, 3): PairSupport(5, 5, 0)})

    assert set(found) == {(1, 3)}


def test_a_few_strangers_prove_nothing():
    pairs = [(a, a + 100) for a in range(OVERLAPS.min_pairs - 1)]
    explained = {(0, 100): PairSupport(300, 300, 0)} | {
        (a + side, a + 1 + side): PairSupport(500, 500, 0) for a in range(20) for side in (0, 100)
    }
    assert find_false_joins({pair: ExpectedOverlap(60, 0) for pair in pairs}, explained) == []


def test_two_false_joins_are_told_apart():
    """Two pairs of streets, each pair on one place, far from each other."""
    overlaps, explained = {}, {}
    for base in (0, 1000):
        for a in range(20):
            for side in (0, 100):
                explained[base + side + a, base + side + a + 1] = PairSupport(500, 500, 0)
                overlaps[base + side + a, base + side + a + 1] = ExpectedOverlap(60, 57)
            for b in range(20):
                alike = 8 <= a <= 10 and 8 <= b <= 10
                overlaps[base + a, base + 100 + b] = ExpectedOverlap(60, 30 if alike else 0)
                if alike:
                    explained[base + a, base + 100 + b] = PairSupport(300, 300, 0)
    explained[20, 1000] = PairSupport(200, 200, 0)
    overlaps[5, 5000] = ExpectedOverlap(40, 20)  # a photo that no pair holds

    found = find_false_joins(overlaps, explained)

    assert len(found) == 2
    for join, base in zip(sorted(found, key=lambda one: one.pairs), (0, 1000), strict=True):
        assert set(join.pairs) == {(base + a, base + 100 + b) for a in (8, 9, 10) for b in (8, 9, 10)}
