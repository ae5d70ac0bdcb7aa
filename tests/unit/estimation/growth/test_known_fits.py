"""Which pairs and lenses of an earlier run are those of this one."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from sfm_app.colmap.database import write_match_graph
from sfm_app.estimation.known import known_fits, known_lenses
from sfm_app.matching.pairs import find_same_matches, pairs_with_new_photos
from sfm_app.types import Calibration, EpipolarFit, MatchedImage, MatchGraph, Rejected, ViewGraph

ROWS = np.column_stack([np.arange(4), np.arange(4)[::-1]]).astype(np.uint32)


def image(key, group="one", name=None):
    return MatchedImage(key, name or f"{key}.jpg", group, 100, 80)


def graph(photos=(1, 2, 3), **others):
    keypoints = {key: np.float64(np.float32(np.random.default_rng(key).uniform(0, 80, (5, 2)))) for key in photos}
    matches = {(a, b): ROWS for a in photos for b in photos if a < b}
    return replace(MatchGraph({key: image(key) for key in photos}, keypoints, matches), **others)


def earlier_run(folder, before, known):
    path = folder / "earlier.db"
    write_match_graph(path, before)
    return SimpleNamespace(place=SimpleNamespace(database=path), known=frozenset(known))


def fit(count=4):
    return EpipolarFit(np.eye(3), np.ones(count, bool), np.ones(count), 10, 0.5)


def test_pairs_with_the_same_bytes_are_the_same(tmp_path):
    earlier = earlier_run(tmp_path, graph(), {"1.jpg", "2.jpg", "3.jpg"})
    now = graph((1, 2, 3, 4))
    same = find_same_matches(now, earlier)
    assert same.photos == {1, 2, 3} and same.pairs == {(1, 2), (1, 3), (2, 3)}

    other = find_same_matches(replace(now, matches=now.matches | {(1, 3): ROWS[:3]}), earlier)
    assert other.photos == {1, 2, 3} and other.pairs == {(1, 2), (2, 3)}


def test_photos_with_other_keypoints_names_or_contents_are_not_the_same(tmp_path):
    earlier = earlier_run(tmp_path, graph(), {"1.jpg", "2.jpg"})
    now = graph()
    assert find_same_matches(now, earlier).photos == {1, 2}  # the third was replaced

    moved = replace(now, keypoints=now.keypoints | {1: now.keypoints[1] + 0.5})
    assert find_same_matches(moved, earlier).photos == {2}
    swapped = replace(now, images=now.images | {1: image(1, name="2.jpg"), 2: image(2, name="1.jpg")})
    assert find_same_matches(swapped, earlier).photos == frozenset()


def test_pairs_of_known_photos_are_not_matched_again():
    images = {key: image(key) for key in (1, 2, 3)}

    assert pairs_with_new_photos([(1, 2), (1, 3), (2, 3)], images, {"1.jpg", "2.jpg"}) == [(1, 3), (2, 3)]
    assert pairs_with_new_photos([(1, 2)], images, set()) == [(1, 2)]


@pytest.fixture
def lens():
    return Calibration(np.eye(3), 100, 80, "lens", True, projection="fisheye", fisheye=(0.1, 0.0, 0.0, 0.0))


def test_fits_stay_where_matches_and_lenses_are_the_same(lens):
    images = {1: image(1), 2: image(2), 3: image(3, "wide"), 4: image(4)}
    matches = graph((1, 2, 3, 4), images=images)
    before = ViewGraph({(1, 2): fit(), (1, 3): fit()}, {(2, 3): Rejected("too few")}, {"wide": lens})
    same = {(1, 2), (1, 3), (2, 3), (1, 4)}

    assert known_fits(matches, before, same, {"wide": lens}).keys() == {(1, 2), (1, 3), (2, 3)}
    assert known_fits(matches, before, same, {}).keys() == {(1, 2)}
    other = replace(lens, fisheye=(0.2, 0.0, 0.0, 0.0))
    assert known_fits(matches, before, same, {"wide": other}).keys() == {(1, 2)}
    assert known_fits(matches, before, {(2, 3)}, {"wide": lens})[2, 3] == (before.rejected[2, 3], 0)


def test_lenses_stay_where_most_photos_are_known(lens):
    images = {key: image(key, "wide" if key < 4 else "usual" if key < 7 else "half") for key in range(1, 9)}
    matches = graph(range(1, 9), images=images)
    earlier = SimpleNamespace(known=frozenset({"1.jpg", "2.jpg", "4.jpg", "5.jpg", "7.jpg"}))

    found = known_lenses(matches, ViewGraph({}, {}, {"wide": lens, "half": lens}), earlier)

    assert found == {"wide": lens, "usual": None}
