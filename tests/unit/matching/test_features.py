"""Features and matches by a plug-in, and the two rounds of matching."""

from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from PIL import Image

from sfm_app.api import open_run
from sfm_app.colmap.database import create_database, read_match_graph
from sfm_app.errors import ConfigError, PluginError
from sfm_app.matching.features import all_pairs, fill_database
from sfm_app.plugins import FeatureMethod, hookimpl, load_plugins
from sfm_app.runtime.context import RunContext
from sfm_app.settings import Settings
from sfm_app.stages import match_graph
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


@pytest.mark.parametrize("find", BROKEN_FINDS.values(), ids=BROKEN_FINDS)
def test_invalid_features_end_the_run_with_the_name_of_the_method(filled, find):
    with pytest.raises(PluginError, match="the features 'odd'"):
        filled(FeatureMethod("odd", find, CORNERS.match))


@pytest.mark.parametrize("rows", BROKEN_MATCHES.values(), ids=BROKEN_MATCHES)
def test_invalid_matches_end_the_run_with_the_name_of_the_method(filled, rows):
    with pytest.raises(PluginError, match="the features 'odd'"):
        filled(FeatureMethod("odd", CORNERS.find, lambda *_: np.array(rows)))


def test_functions_and_options_of_sift_exclude_each_other():
    for parts in ({}, {"find": CORNERS.find}, {"find": CORNERS.find, "match": CORNERS.match, "sift": {}}):
        with pytest.raises(PluginError, match="'half'"):
            FeatureMethod("half", **parts)


def test_a_method_that_cannot_run_here_is_refused_before_any_work():
    @hookimpl
    def sfm_features():
        return [FeatureMethod("gone", CORNERS.find, CORNERS.match, unavailable=lambda: "no such chip")]

    plugins = load_plugins([SimpleNamespace(sfm_features=sfm_features)], installed=False)
    assert list(plugins.features)[:2] == ["sift", "sift-affine"]
    with pytest.raises(ConfigError, match="'gone' cannot be used here: no such chip"):
        plugins.feature_method("gone")
    with pytest.raises(ConfigError, match="no feature method is named 'surf'"):
        plugins.feature_method("surf")


PHOTOS, SIDE, STEP = 24, 200, 55


@pytest.fixture(scope="module")
def wall():
    """The wall as gray values, with things of all sizes."""
    rng = np.random.default_rng(0)
    size = PHOTOS * STEP + SIDE, SIDE
    layers = [cv2.resize(rng.normal(size=(-(-size[1] // k), -(-size[0] // k))), size) * k for k in (4, 8, 16, 32)]
    picture = sum(layers)
    return np.uint8(255 * (picture - picture.min()) / np.ptp(picture))


@pytest.fixture
def matched(tmp_path, wall):
    """Matches the photos, and gives the match graph and what the manifest says."""

    def match(workers=1, method=None, names=None, **matching):
        out = tmp_path / f"out{workers}"
        named = names or [f"wall {k:02d}.png" for k in range(PHOTOS)]
        photos = PhotoSet(tmp_path, tuple(Photo(name, SIDE, SIDE, "g") for name in sorted(named)))
        settings = Settings.from_mapping({"workers": workers, "matching": {"neighbors": 4} | matching})
        with open_run(out, settings, None) as opened:
            run: RunContext = opened.with_fingerprint("same")
            run.workspace.photos.mkdir(parents=True, exist_ok=True)
            for k, name in enumerate(named):
                Image.fromarray(wall[:, STEP * k : STEP * k + SIDE]).save(run.workspace.photos / name)
            return match_graph.make(photos, run), run

    return match


def apart(graph, names=None):
    """Return how many steps the photos of each matched pair are apart."""
    place = {image.name: k for k, image in enumerate(sorted(graph.images.values(), key=lambda one: one.name))}
    if names:
        place = {name: k for k, name in enumerate(names)}
    return [abs(place[graph.images[a].name] - place[graph.images[b].name]) for a, b in graph.matches]


def test_photos_are_matched_with_those_that_show_the_same_by_any_number_of_workers(matched):
    graph, run = matched()
    two = matched(workers=2)[0].matches
    assert list(graph.matches) == list(two)
    assert all(np.array_equal(rows, two[pair]) for pair, rows in graph.matches.items())
    asked = run.statistics["matched_pairs"]
    assert PHOTOS < asked < 0.6 * PHOTOS * (PHOTOS - 1) / 2
    gaps = apart(graph)
    assert gaps.count(1) == PHOTOS - 1 and gaps.count(2) == PHOTOS - 2
    strong = {pair for pair, rows in graph.matches.items() if len(rows) > 20}
    assert all(gap <= 2 for gap, pair in zip(gaps, graph.matches, strict=True) if pair in strong)


def test_names_that_say_nothing_do_not_matter(matched):
    names = [f"{k:02d}.png" for k in np.random.default_rng(1).permutation(PHOTOS)]
    graph, _ = matched(names=names)
    gaps = apart(graph, names)
    assert gaps.count(1) == PHOTOS - 1 and gaps.count(2) >= PHOTOS - 4


def test_photos_with_other_features_are_chosen_by_their_pictures(matched):
    asked = []

    def find(picture, _):
        at = np.array([[20.0, 20.0], [180.0, 20.0], [20.0, 180.0]])
        return Features(picture.shape[1::-1], at, {"number": np.arange(3)})

    def match(first, second, _):
        asked.append((first, second))
        return np.column_stack([np.arange(3), np.arange(3)])

    def look_up(self, name):
        return FeatureMethod("three", find, match)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("sfm_app.plugins.Plugins.feature_method", look_up)
        graph, run = matched()

    gaps = apart(graph)
    assert len(asked) == len(gaps) == run.statistics["matched_pairs"] < PHOTOS * (PHOTOS - 1) / 2
    assert gaps.count(1) == PHOTOS - 1 and gaps.count(2) >= PHOTOS - 4
