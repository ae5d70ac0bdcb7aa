"""Pairs to match: choice by rank, and chunks of pairs."""

import itertools

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sfm_app.matching.features import cut_pairs
from sfm_app.retrieval import choose_by_rank, expected_pairs, pairs_in_order, pairs_nearby, spread, wants_all_pairs
from sfm_app.settings import MatchSettings
from sfm_app.types import GpsPosition, MatchedImage


def image(photo, name="", **known):
    return MatchedImage(photo, name or f"{photo:03d}.jpg", "camera", 100, 100, **known)


@given(st.integers(1, 50), st.integers(0, 300))
def test_partners_are_the_nearest_and_some_of_the_rest(count, ranked):
    found = spread(range(ranked), count)
    assert len(found) == min(count, ranked) == len(set(found))
    assert found == sorted(found)
    nearest = round(0.4 * count) if ranked > count else ranked
    assert found[:nearest] == list(range(nearest))
    if ranked > 2 * count >= 10:
        assert found[-1] >= 0.7 * ranked, "the far end has partners, too"


def test_every_photo_gets_its_best_partners():
    scores = {(a, b): 100 - (b - a) for a in range(30) for b in range(a + 1, 30)}
    chosen = choose_by_rank(scores, 80, 6)
    assert all((k, k + 1) in chosen for k in range(29))
    assert all(scores[pair] >= 80 for pair in chosen)
    assert 3 * 30 <= len(chosen) <= 6 * 30


def test_pairs_in_order_stay_within_a_folder_and_count_as_people_do():
    images = [image(k, name) for k, name in enumerate(["a/2.jpg", "a/10.jpg", "a/1.jpg", "b/3.jpg"])]
    assert pairs_in_order(images, (1,)) == {(0, 2), (0, 1)}
    assert pairs_in_order(images, (1, 2)) == {(0, 2), (0, 1), (1, 2)}


def test_frames_are_in_the_order_of_their_times():
    images = [image(k, f"{9 - k}.jpg", time_s=float(k)) for k in range(4)]
    assert pairs_in_order(images, (1,)) == {(0, 1), (1, 2), (2, 3)}


def test_gps_pairs_are_the_nearest_places():
    places = [(50.0, 8.0), (50.0, 8.0001), (50.0, 8.1), (50.0, 8.1001)]
    images = [image(k, gps=GpsPosition(*place)) for k, place in enumerate(places)] + [image(9)]
    assert pairs_nearby(images, 1) == {(0, 1), (2, 3)}
    assert pairs_nearby(images[-1:], 3) == pairs_nearby([], 3) == set()


@pytest.mark.parametrize(("pairs", "photos", "wanted"), [
    ("auto", 20, True), ("auto", 61, True), ("auto", 62, False), ("all", 5000, True), ("retrieval", 31, True),
    ("retrieval", 32, False), ("sequence", 31, True), ("sequence", 40, False),
])  # fmt: skip
def test_all_pairs_are_matched_where_that_is_cheaper(pairs, photos, wanted):
    assert wants_all_pairs(photos, MatchSettings(pairs=pairs, neighbors=30)) is wanted


def test_the_pairs_of_a_choice_grow_with_the_photos():
    options = MatchSettings(neighbors=30)
    assert expected_pairs(10, options) == 45
    assert expected_pairs(2000, options) == 2 * expected_pairs(1000, options) == 60_000
    assert expected_pairs(1000, MatchSettings(pairs="all")) == 499_500


@given(
    st.sets(st.tuples(st.integers(1, 30), st.integers(1, 30)).filter(lambda pair: pair[0] < pair[1]), max_size=80),
    st.integers(1, 20),
)
def test_every_pair_is_in_one_chunk_and_all_but_the_last_are_full(pairs, size):
    found = cut_pairs(sorted(pairs), size)
    assert sorted(pair for chunk in found for pair in chunk) == sorted(pairs)
    assert all(len(chunk) == size for chunk in found[:-1])
    assert all(1 <= len(chunk) <= size for chunk in found[-1:])


def test_the_order_of_pairs_changes_nothing_but_the_order_within_a_pair_stays():
    pairs = list(itertools.combinations(range(12), 2))
    turned = [pair[::-1] for pair in reversed(pairs)]
    assert cut_pairs(turned, 7) == [[pair[::-1] for pair in chunk] for chunk in cut_pairs(pairs, 7)]


@pytest.mark.parametrize(
    ("pairs", "size", "most"),
    [
        (list(itertools.combinations(range(40), 2)), 100, 1.45),  # least: 15 photos in every chunk
        ([(k, k + step) for k in range(300) for step in range(1, 11)], 250, 1.6),  # least: 31 photos
    ],
)
def test_chunks_have_few_photos(pairs, size, most):
    photos = [len({photo for pair in chunk for photo in pair}) for chunk in cut_pairs(pairs, size)]
    in_order = [len({p for pair in pairs[k : k + size] for p in pair}) for k in range(0, len(pairs), size)]
    least = 15 if size == 100 else 31
    assert least * 0.99 <= sum(photos) / len(photos) <= most * least
    assert sum(photos) <= 1.02 * sum(in_order)
