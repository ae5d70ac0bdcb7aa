"""From photos to confirmed depth maps."""

from dataclasses import replace

import numpy as np
import pytest

from sfm_app.stereo import DepthEstimate, DepthMap, confirm_depths, match_depths, rank_neighbors, region
from sfm_app.stereo.view import View
from sfm_app.types import Rejected

pytestmark = pytest.mark.slow

CENTERS = [(-0.5, 0, 0), (0, 0, 0), (0.5, 0.1, 0), (0.1, 0.5, 0.05)]


@pytest.fixture(scope="module")
def views(make_view):
    return [make_view(center, name=f"{i}.jpg") for i, center in enumerate(CENTERS)]


@pytest.fixture(scope="module")
def matched(plane, views):
    ranked = rank_neighbors(views, 3)
    return [
        match_depths(view, [views[j] for j in row], plane.photo, 3, 0.01)
        for view, row in zip(views, ranked, strict=True)
    ]


def others(views, matched, index):
    return [(views[j], matched[j].depth) for j in range(len(views)) if j != index]


def test_confirmed_depths_lie_on_the_plane(plane, views, matched):
    found = confirm_depths(views[1], plane.photo(views[1]), matched[1], others(views, matched, 1), 1, 0.01)

    assert isinstance(found, DepthMap)
    known = found.depth > 0
    error = np.abs(found.depth / plane.depth(views[1]) - 1)[known]
    assert 0.8 < np.mean(found.depth > 0) <= 1
    assert 2e-4 < np.median(error) < 3e-3  # a disparity of 28 px, known to 0.05 px
    assert np.percentile(error, 99) < 0.02
    cosine = -(found.normals[known] @ plane.normal)
    assert np.degrees(np.arccos(np.median(cosine))) < 6
    np.testing.assert_allclose(np.linalg.norm(found.normals[known], axis=1), 1, rtol=1e-5)
    assert not found.normals[~known].any()


def test_false_depths_do_not_get_through(plane, views, matched):
    wrong = replace(matched[1], depth=matched[1].depth * np.float32(1.04))

    found = confirm_depths(views[1], plane.photo(views[1]), wrong, others(views, matched, 1), 2, 0.01)

    assert isinstance(found, Rejected) or np.mean(found.depth > 0) < 0.02


def test_two_photos_confirm_each_other(plane, views, matched):
    found = confirm_depths(views[1], plane.photo(views[1]), matched[1], others(views, matched, 1)[:1], 2, 0.01)

    assert isinstance(found, DepthMap)
    assert np.mean(found.depth > 0) > 0.4


def test_same_input_gives_the_same_bytes(plane, views, matched):
    again = match_depths(views[1], [views[j] for j in rank_neighbors(views, 3)[1]], plane.photo, 3, 0.01)

    assert again.depth.tobytes() == matched[1].depth.tobytes()
    assert again.confidence.tobytes() == matched[1].confidence.tobytes()


def test_a_photo_without_neighbors_is_a_value_with_a_reason(plane, views):
    assert match_depths(views[0], [], plane.photo, 3, 0.01) == Rejected("no photo shares enough points")
    same_place = match_depths(views[0], [views[0]], plane.photo, 3, 0.01)
    assert same_place == Rejected("the photos were taken from the same place")
    empty = np.zeros((180, 240), np.float32)
    nothing, blank = DepthEstimate(empty, empty), np.zeros((180, 240), np.uint8)
    assert isinstance(confirm_depths(views[0], blank, nothing, [(views[1], empty)], 2, 0.01), Rejected)
    assert isinstance(confirm_depths(views[0], blank, nothing, [], 2, 0.01), Rejected)


@pytest.mark.parametrize(("confidence", "needed"), [(0.9, 1), (0.6, 1), (0.4, 2), (0.1, 4)])
def test_the_less_alike_photos_look_the_more_have_to_agree(plane, views, confidence, needed):
    truth = [plane.depth(view) for view in views]
    # four of three never agree: what is hardly to be seen stays empty in small sets
    estimate = DepthEstimate(truth[1], np.full_like(truth[1], confidence))
    true, false = [(views[j], truth[j]) for j in (0, 2, 3)], [(views[j], 1.5 * truth[j]) for j in (0, 2, 3)]

    for agreeing in range(4):
        found = confirm_depths(views[1], plane.photo(views[1]), estimate, true[:agreeing] + false[agreeing:], 1, 0.01)
        assert isinstance(found, DepthMap) == (agreeing >= needed)


def test_blank_photos_are_left_empty(views):
    rng = np.random.default_rng(0)

    def sky(view):
        return rng.normal(200, 1.5, (view.height, view.width)).astype(np.uint8)

    found = match_depths(views[1], [views[0], views[2]], sky, 2, 0.01)

    assert np.median(found.confidence) < 0.3
    sure = confirm_depths(views[1], sky(views[1]), found, [(views[j], found.depth) for j in (0, 2)], 2, 0.01)
    assert isinstance(sure, Rejected) or np.mean(sure.depth > 0) < 0.02


def test_region_leaves_strays_out():
    points = np.random.default_rng(0).uniform(-1, 1, (1000, 3))
    points[0] = 500.0
    view = View("v", np.eye(3), np.eye(3), np.zeros(3), 10, 10, np.arange(1000), points)

    low, high = region([view])

    assert np.all((low > -1.5) & (low < -1.2))
    assert np.all((high < 1.5) & (high > 1.2))


@pytest.mark.parametrize("gray", [0, 255])
def test_what_is_black_or_blown_out_is_not_made_up_from_what_is_beside_it(plane, views, gray):
    def photo(view):
        pixels = plane.photo(view).clip(20, 235)
        pixels[:, 120:] = gray
        return pixels

    found = match_depths(views[1], [views[0], views[2]], photo, 2, 0.01)

    assert np.mean(found.depth[5:-5, 5:119] > 0) > 0.8
    assert not found.depth[:, 121:].any()
