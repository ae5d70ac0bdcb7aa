"""Pairs to match: choice by rank, and two rounds."""

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from sfm_app.api import open_run
from sfm_app.plugins import FeatureMethod
from sfm_app.retrieval import choose_by_rank, expected_pairs, pairs_in_order, pairs_nearby, spread, wants_all_pairs
from sfm_app.runtime.context import RunContext
from sfm_app.settings import MatchSettings, Settings
from sfm_app.stages import match_graph
from sfm_app.types import Features, GpsPosition, MatchedImage, Photo, PhotoSet


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


pytestmark = pytest.mark.slow

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


def test_photos_are_matched_with_those_that_show_the_same(matched):
    graph, run = matched()

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


def test_any_number_of_workers_matches_the_same(matched):
    one, two = matched(workers=1)[0], matched(workers=2)[0]

    assert list(one.matches) == list(two.matches)
    assert all(np.array_equal(rows, two.matches[pair]) for pair, rows in one.matches.items())


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
