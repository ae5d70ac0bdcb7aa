"""Features and matches by a plug-in, and chunks of pairs."""

import itertools
from types import SimpleNamespace

import hypothesis.strategies as st
import numpy as np
import pytest
from hypothesis import given
from PIL import Image

from sfm_app.api import open_run
from sfm_app.colmap.database import create_database, read_match_graph
from sfm_app.errors import ConfigError, PluginError
from sfm_app.matching.features import all_pairs, cut_pairs, fill_database
from sfm_app.plugins import FeatureMethod, hookimpl, load_plugins
from sfm_app.settings import Settings
from sfm_app.types import Features, Photo, PhotoSet

pytestmark = pytest.mark.slow

SIZE = 200, 100
NAMES = ("a b.png", "c.png", "d.png")


class Corners:
    """Finds four keypoints and matches them by number; notes what it was asked, and can be killed."""

    def __init__(self, kill_after=99):
        self.seen, self.matched, self.kill_after = [], 0, kill_after

    def find(self, picture, _):
        height, width = picture.shape[:2]
        self.seen.append((width, height, tuple(picture[0, 0])))
        at = np.array([[0.25, 0.25], [0.75, 0.25], [0.25, 0.75], [0.75, 0.75]]) * [width, height]
        return Features((width, height), at, {"number": np.arange(4)})

    def match(self, first, second, _):
        self.matched += 1
        if self.matched > self.kill_after:
            raise KeyboardInterrupt
        return np.argwhere(first.values["number"][:, None] == second.values["number"][None])

    @property
    def method(self):
        return FeatureMethod("corners", self.find, self.match)


@pytest.fixture
def filled(tmp_path):
    """Runs a method on three photos of red, green and blue, and gives the match graph."""
    photos = PhotoSet(tmp_path, tuple(Photo(name, *SIZE, "g") for name in NAMES))

    def fill(method, pairs=None, **matching):
        with open_run(tmp_path / "out", Settings.from_mapping({"workers": 1, "matching": matching}), None) as run:
            run.workspace.photos.mkdir(parents=True, exist_ok=True)
            for name, color in zip(NAMES, ("red", "lime", "blue"), strict=True):
                Image.new("RGB", SIZE, color).save(run.workspace.photos / name)
            if not run.workspace.database.exists():
                create_database(run.workspace.database, photos)
            fill_database(method, run.with_fingerprint("same"), pairs)
            assert not run.workspace.feature_parts.exists()
            return read_match_graph(run.workspace.database, photos)

    return fill


def test_every_photo_is_seen_once_in_its_colors_and_every_pair_matched(filled):
    ways = Corners()
    graph = filled(ways.method)

    assert ways.seen == [(200, 100, (255, 0, 0)), (200, 100, (0, 255, 0)), (200, 100, (0, 0, 255))]
    assert list(graph.matches) == all_pairs([3, 1, 2]) == [(1, 2), (1, 3), (2, 3)]
    np.testing.assert_array_equal(graph.keypoints[2], [[50, 25], [150, 25], [50, 75], [150, 75]])
    np.testing.assert_array_equal(graph.matches[1, 3], np.column_stack([np.arange(4), np.arange(4)]))


def test_pictures_are_shrunk_and_keypoints_are_not(filled):
    ways = Corners()
    graph = filled(ways.method, max_image_size_px=150)

    assert {seen[:2] for seen in ways.seen} == {(150, 75)}
    np.testing.assert_array_equal(graph.keypoints[1], [[50, 25], [150, 25], [50, 75], [150, 75]])


def test_no_more_pairs_than_asked_for_and_no_photos_but_theirs(filled):
    ways = Corners()
    assert list(filled(ways.method, [(2, 3)]).matches) == [(2, 3)]
    assert ways.matched == 1 and len(ways.seen) == 2


def test_a_killed_run_goes_on_where_it_stopped(filled):
    first, second = Corners(kill_after=1), Corners()
    with pytest.raises(KeyboardInterrupt):
        filled(first.method)
    graph = filled(second.method)

    assert second.seen == []
    assert second.matched == 2
    assert list(graph.matches) == [(1, 2), (1, 3), (2, 3)]


def test_pairs_without_a_match_are_in_no_graph_and_not_tried_again(filled):
    ways = Corners()
    none = FeatureMethod("none", ways.find, lambda *_: np.zeros((0, 2), np.int64))
    assert filled(none).matches == {}
    assert filled(ways.method).matches == {}
    assert ways.matched == 0


def test_a_photo_without_features_is_matched_with_nothing(filled):
    ways = Corners()
    blind = FeatureMethod("blind", lambda *_: Features(SIZE, np.zeros((0, 2))), ways.match)
    graph = filled(blind)
    assert graph.matches == {}
    assert [points.shape for points in graph.keypoints.values()] == [(0, 2)] * 3
    assert ways.matched == 0


CORNERS = Corners()
BROKEN_FINDS = {
    "another size": lambda *_: Features((10, 10), np.zeros((1, 2))),
    "outside": lambda *_: Features(SIZE, np.array([[201.0, 5.0]])),
    "not a number": lambda *_: Features(SIZE, np.array([[np.nan, 5.0]])),
    "three columns": lambda *_: Features(SIZE, np.zeros((1, 3))),
    "too few values": lambda *_: Features(SIZE, np.zeros((2, 2)), {"descriptors": np.zeros((1, 5))}),
    "raises": lambda *_: 1 / 0,
}
BROKEN_MATCHES = {
    "twice": [[0, 1], [0, 2]],
    "not there": [[0, 4]],
    "negative": [[-1, 0]],
    "floats": [[0.0, 1.0]],
    "one column": [[0], [1]],
}


@pytest.mark.parametrize("how", BROKEN_FINDS)
def test_features_that_cannot_be_end_the_run_with_their_name(filled, how):
    with pytest.raises(PluginError, match="the features 'odd'"):
        filled(FeatureMethod("odd", BROKEN_FINDS[how], CORNERS.match))


@pytest.mark.parametrize("how", BROKEN_MATCHES)
def test_matches_that_cannot_be_end_the_run_with_their_name(filled, how):
    with pytest.raises(PluginError, match="the features 'odd'"):
        filled(FeatureMethod("odd", CORNERS.find, lambda *_: np.array(BROKEN_MATCHES[how])))


def test_functions_and_options_of_sift_exclude_each_other():
    for parts in ({}, {"find": CORNERS.find}, {"find": CORNERS.find, "match": CORNERS.match, "sift": {}}):
        with pytest.raises(PluginError, match="'half'"):
            FeatureMethod("half", **parts)


def test_a_method_that_cannot_run_here_is_refused_before_any_work():
    @hookimpl
    def sfm_features():
        return [FeatureMethod("gone", CORNERS.find, CORNERS.match, unavailable=lambda: "no such chip")]

    plugins = load_plugins([SimpleNamespace(sfm_features=sfm_features)], installed=False)
    assert list(plugins.features)[:2] == ["sift", "sift-dsp"]
    with pytest.raises(ConfigError, match="'gone' cannot be used here: no such chip"):
        plugins.feature_method("gone")
    with pytest.raises(ConfigError, match="no way to find features is named 'surf'"):
        plugins.feature_method("surf")


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
