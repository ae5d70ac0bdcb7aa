"""Chunks of pairs: nothing is lost, and each has few photos."""

import itertools

import hypothesis.strategies as st
import pytest
from hypothesis import given

from sfm_app.matching.features import cut_pairs


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
