"""Vocabulary, similar photos and previews."""

import numpy as np
import pytest

from sfm_app.retrieval import (
    count_preview_matches,
    count_shared_keypoints,
    describe_picture,
    learn_vocabulary,
    nearest_words,
    pool_descriptors,
    rank_similar,
)

PHOTOS, SEEN, STEP = 40, 100, 20


def street(seed=0, noise=6.0):
    """Return descriptors of photos along a street; photos share fewer things the further they are apart."""
    rng = np.random.default_rng(seed)
    things = rng.integers(0, 256, (PHOTOS * STEP + SEEN, 128))
    shown = [things[STEP * k : STEP * k + SEEN] for k in range(PHOTOS)]
    return [np.clip(one + rng.normal(scale=noise, size=one.shape), 0, 255).astype(np.uint8) for one in shown]


def words_of(photos, size=300):
    vocabulary = learn_vocabulary(pool_descriptors(photos, 10_000), size, seed=0)
    return vocabulary, [nearest_words(vocabulary, one) for one in photos]


def test_the_rank_similar_photos_are_the_neighbors():
    vocabulary, words = words_of(street())
    ranked = rank_similar(words, len(vocabulary), 4)
    for photo, others in enumerate(ranked[4:-4], start=4):
        assert {photo - 1, photo + 1} == set(others[:2].tolist())
        assert np.abs(others - photo).max() <= 4


def test_a_photo_without_words_has_no_similar_ones():
    vocabulary, words = words_of(street())
    ranked = rank_similar([*words, np.zeros(0, np.int64)], len(vocabulary), 5)
    assert len(ranked[-1]) == 0 and all(PHOTOS not in others for others in ranked)


def test_a_word_counts_with_the_root_of_its_frequency():
    words = [np.array(one, np.int64) for one in ([0, 0, 0, 0, 1], [0, 3], [1], [5])]
    assert rank_similar(words, 6, 3)[0].tolist() == [2, 1]  # four times as often: 4 * 0.45 > 1 > 2 * 0.45


def test_words_are_whole_numbers_and_descriptors_belong_to_the_nearest():
    photos = street()
    vocabulary, words = words_of(photos)
    assert 200 <= len(vocabulary) <= 320
    assert np.array_equal(vocabulary, np.rint(vocabulary))
    distances = np.linalg.norm(photos[3][:, None].astype(float) - vocabulary, axis=2)
    chosen = distances[np.arange(SEEN), words[3]]
    assert np.array_equal(chosen, distances.min(axis=1))


@pytest.mark.parametrize("count", [0, 1, 5])
def test_few_descriptors_give_few_words(count):
    descriptors = np.random.default_rng(0).integers(0, 256, (count, 128)).astype(np.uint8)
    if count:
        assert len(learn_vocabulary(descriptors, 100, 0)) == count
    assert len(pool_descriptors([descriptors], 100)) == count


def test_a_preview_counts_what_two_photos_share():
    photos = street()
    assert count_preview_matches(photos[5], photos[6:10]) == [80, 60, 40, 20]
    assert max(count_preview_matches(photos[5], photos[12:])) <= 3


def test_a_preview_of_nothing_is_zero():
    nothing, some = np.zeros((0, 128), np.uint8), street()[0]
    assert count_preview_matches(nothing, [some, nothing]) == [0, 0]
    assert count_preview_matches(some, [nothing, some[:1]]) == [0, 0]
    assert count_preview_matches(some, []) == []


def test_repeated_things_do_not_count_in_a_preview():
    photo = street()[0]
    assert count_preview_matches(photo, [np.concatenate([photo, photo])]) == [0]


def test_friends_are_counted_by_the_points_that_a_third_photo_shares_with_both():
    rows = np.arange(10, dtype=np.uint32)
    matches = {
        (1, 2): np.column_stack([rows, rows]),
        (2, 3): np.column_stack([rows[4:], rows[4:]]),
        (3, 4): np.column_stack([rows[:2], rows[:2]]),
    }
    found = count_shared_keypoints(dict.fromkeys(range(1, 6), 10), matches)
    assert found == {(1, 3): 6}, "the points of (3, 4) are not those of (2, 3)"


def test_friends_of_many_photos_are_counted_block_by_block():
    rng = np.random.default_rng(0)
    pairs = {(a, b) for a, b in rng.integers(1, 30, (80, 2)).tolist() if a < b}
    matches = {pair: np.unique(rng.integers(0, 50, (20, 2)), axis=0).astype(np.uint32) for pair in sorted(pairs)}
    keypoints = dict.fromkeys(range(1, 30), 50)
    whole = count_shared_keypoints(keypoints, matches)
    assert count_shared_keypoints(keypoints, matches, block=4) == whole and len(whole) > 50


def test_a_picture_is_described_whatever_its_features():
    rng = np.random.default_rng(0)
    picture = np.kron(rng.integers(0, 255, (30, 40)), np.ones((16, 16)))[..., None].repeat(3, axis=2).astype(np.uint8)
    found = describe_picture(picture, 50)
    assert found.shape == (50, 128) and found.dtype == np.uint8 and found.any(axis=1).all()
    assert describe_picture(np.full((50, 50, 3), 128, np.uint8), 50).shape == (0, 128)
