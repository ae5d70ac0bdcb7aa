"""Depth maps from photos; confirmation by other maps, speckles."""

from dataclasses import replace

import numpy as np
import pytest

from sfm_app.stereo import DepthEstimate, DepthMap, confirm_depths, match_depths, rank_neighbors
from sfm_app.stereo.depth import OPTIONS, count_maps, filter_speckles
from sfm_app.types import Rejected

slow = pytest.mark.slow
CENTERS = [(-0.5, 0, 0), (0, 0, 0), (0.5, 0.1, 0), (0.1, 0.5, 0.05)]


@pytest.fixture(scope="module")
def views(make_view):
    return [make_view(center, name=f"{i}.jpg") for i, center in enumerate(CENTERS)]


@pytest.fixture(scope="module")
def matched(plane, views):
    ranked = rank_neighbors(views, 3)
    return [
        match_depths(view, [views[j] for j in row], plane.photo, 3) for view, row in zip(views, ranked, strict=True)
    ]


def others(views, matched, index):
    return [(views[j], matched[j].depth) for j in range(len(views)) if j != index]


@slow
def test_confirmed_depths_lie_on_the_plane(plane, views, matched):
    maps = confirm_depths(views[1], plane.photo(views[1]), matched[1], others(views, matched, 1), 1, 0.01)

    assert isinstance(maps, DepthMap)
    known = maps.depth > 0
    error = np.abs(maps.depth / plane.depth(views[1]) - 1)[known]
    assert 0.8 < np.mean(known) <= 1
    assert 2e-4 < np.median(error) < 3e-3  # a disparity of 28 px, known to 0.05 px
    assert np.percentile(error, 99) < 0.02
    cosine = -(maps.normals[known] @ plane.normal)
    assert np.degrees(np.arccos(np.median(cosine))) < 6
    np.testing.assert_allclose(np.linalg.norm(maps.normals[known], axis=1), 1, rtol=1e-5)
    assert not maps.normals[~known].any()


@slow
def test_wrong_depths_are_dropped(plane, views, matched):
    wrong = replace(matched[1], depth=matched[1].depth * np.float32(1.04))

    maps = confirm_depths(views[1], plane.photo(views[1]), wrong, others(views, matched, 1), 2, 0.01)

    assert isinstance(maps, Rejected) or np.mean(maps.depth > 0) < 0.02


@slow
def test_two_photos_confirm_each_other_and_the_same_input_gives_the_same_bytes(plane, views, matched):
    maps = confirm_depths(views[1], plane.photo(views[1]), matched[1], others(views, matched, 1)[:1], 2, 0.01)
    again = match_depths(views[1], [views[j] for j in rank_neighbors(views, 3)[1]], plane.photo, 3)

    assert isinstance(maps, DepthMap)
    assert np.mean(maps.depth > 0) > 0.4
    assert again.depth.tobytes() == matched[1].depth.tobytes()
    assert again.confidence.tobytes() == matched[1].confidence.tobytes()


@slow
def test_a_photo_without_neighbors_has_a_reason(plane, views):
    assert match_depths(views[0], [], plane.photo, 3) == Rejected("no photo shares enough points")
    same_place = match_depths(views[0], [views[0]], plane.photo, 3)
    assert same_place == Rejected("the photos were taken from the same place")
    empty = np.zeros((180, 240), np.float32)
    nothing, blank = DepthEstimate(empty, empty), np.zeros((180, 240), np.uint8)
    assert isinstance(confirm_depths(views[0], blank, nothing, [(views[1], empty)], 2, 0.01), Rejected)
    assert isinstance(confirm_depths(views[0], blank, nothing, [], 2, 0.01), Rejected)


@slow
@pytest.mark.parametrize(("confidence", "needed"), [(0.9, 1), (0.6, 1), (0.4, 2), (0.1, 4)])
def test_a_lower_correlation_needs_more_maps(plane, views, confidence, needed):
    truth = [plane.depth(view) for view in views]
    # four of three never agree: weak texture stays empty in small sets
    estimate = DepthEstimate(truth[1], np.full_like(truth[1], confidence))
    true, false = [(views[j], truth[j]) for j in (0, 2, 3)], [(views[j], 1.5 * truth[j]) for j in (0, 2, 3)]

    for agreeing in range(4):
        maps = confirm_depths(views[1], plane.photo(views[1]), estimate, true[:agreeing] + false[agreeing:], 1, 0.01)
        assert isinstance(maps, DepthMap) == (agreeing >= needed)


@slow
def test_blank_photos_stay_empty(views):
    rng = np.random.default_rng(0)

    def sky(view):
        return rng.normal(200, 1.5, (view.height, view.width)).astype(np.uint8)

    estimate = match_depths(views[1], [views[0], views[2]], sky, 2)

    assert np.median(estimate.confidence) < 0.3
    maps = confirm_depths(views[1], sky(views[1]), estimate, [(views[j], estimate.depth) for j in (0, 2)], 2, 0.01)
    assert isinstance(maps, Rejected) or np.mean(maps.depth > 0) < 0.02


@slow
@pytest.mark.parametrize("gray", [0, 255])
def test_clipped_pixels_get_no_depth_from_their_neighbors(plane, views, gray):
    def photo(view):
        pixels = plane.photo(view).clip(20, 235)
        pixels[:, 120:] = gray
        return pixels

    depth = match_depths(views[1], [views[0], views[2]], photo, 2).depth

    assert np.mean(depth[5:-5, 5:119] > 0) > 0.8
    assert not depth[:, 121:].any()


# Confirmation.


def test_true_depths_are_confirmed_and_wrong_ones_are_not(plane, make_view):
    view = make_view((0, 0, 0))
    others = [make_view((0.3, 0, 0)), make_view((-0.2, 0.1, 0.1), turn=(0.05, 0.02, 0.3))]
    maps = [(other, plane.depth(other)) for other in others]
    depth = plane.depth(view)
    depth[80:100, 100:140] *= 1.05
    depth[100:110, 100:140] = 0

    agreeing = count_maps(view, depth, maps, 0.01)

    assert not agreeing[80:110, 100:140].any()
    assert np.all(agreeing[30:70, 60:180] == 2)
    assert agreeing.max() == 2
    ahead = make_view((0, 0, 9))  # the plane is behind it
    assert not count_maps(view, depth, [(ahead, np.abs(plane.depth(ahead)))], 0.01).any()


def test_specks_go_and_thin_objects_stay():
    depth = np.zeros((300, 400), np.float32)
    depth[50:250, 100:300] = np.linspace(4, 6, 200, dtype=np.float32)  # slanted: a pixel differs little from the next
    depth[100:104, 150:154] = 9.0  # hangs behind the surface
    depth[10:14, 10:14] = 5.0
    depth[280:282, 20:220] = 3.0

    filtered = filter_speckles(depth, 0.01)

    assert 16 < OPTIONS.min_patch * depth.size < 400
    assert not filtered[100:104, 150:154].any()
    assert not filtered[10:14, 10:14].any()
    assert np.array_equal(filtered[280:282], depth[280:282])
    assert np.count_nonzero(filtered) == 200 * 200 - 16 + 400
    assert not filter_speckles(np.zeros((30, 40), np.float32), 0.01).any()
