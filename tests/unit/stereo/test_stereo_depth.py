"""From photos to confirmed depth maps."""

import numpy as np
import pytest

from sfm_app.stereo import DepthMap, confirm_depths, match_depths, rank_neighbours, region
from sfm_app.stereo.view import View
from sfm_app.types import Rejected

CENTERS = [(-0.5, 0, 0), (0, 0, 0), (0.5, 0.1, 0), (0.1, 0.5, 0.05)]


@pytest.fixture(scope="module")
def views(make_view):
    return [make_view(center, name=f"{i}.jpg") for i, center in enumerate(CENTERS)]


@pytest.fixture(scope="module")
def matched(plane, views):
    ranked = rank_neighbours(views, 3)
    return [
        match_depths(view, [views[j] for j in row], plane.photo, 3, 0.01)
        for view, row in zip(views, ranked, strict=True)
    ]


def others(views, matched, index):
    return [(views[j], matched[j]) for j in range(len(views)) if j != index]


def test_confirmed_depths_lie_on_the_plane(plane, views, matched):
    found = confirm_depths(views[1], matched[1], others(views, matched, 1), 2, 0.01)

    assert isinstance(found, DepthMap)
    known = found.depth > 0
    error = np.abs(found.depth / plane.depth(views[1]) - 1)[known]
    assert found.coverage == pytest.approx(np.mean(known))
    assert 0.8 < found.coverage <= 1
    assert 2e-4 < np.median(error) < 3e-3  # a disparity of 28 px, known to 0.05 px
    assert np.percentile(error, 99) < 0.02
    cosine = -(found.normals[known] @ plane.normal)
    assert np.degrees(np.arccos(np.median(cosine))) < 6
    np.testing.assert_allclose(np.linalg.norm(found.normals[known], axis=1), 1, rtol=1e-5)
    assert not found.normals[~known].any()


def test_false_depths_do_not_get_through(views, matched):
    wrong = np.where(matched[1] > 0, matched[1] * np.float32(1.04), np.float32(0))

    found = confirm_depths(views[1], wrong, others(views, matched, 1), 2, 0.01)

    assert isinstance(found, Rejected) or found.coverage < 0.02


def test_two_photos_confirm_each_other(views, matched):
    found = confirm_depths(views[1], matched[1], others(views, matched, 1)[:1], 2, 0.01)

    assert isinstance(found, DepthMap)
    assert found.coverage > 0.4


def test_same_input_gives_the_same_bytes(plane, views, matched):
    again = match_depths(views[1], [views[j] for j in rank_neighbours(views, 3)[1]], plane.photo, 3, 0.01)

    assert again.tobytes() == matched[1].tobytes()


def test_a_photo_without_neighbours_is_a_value_with_a_reason(plane, views):
    assert match_depths(views[0], [], plane.photo, 3, 0.01) == Rejected("no photo shares enough points")
    same_place = match_depths(views[0], [views[0]], plane.photo, 3, 0.01)
    assert same_place == Rejected("same place")
    empty = np.zeros((180, 240), np.float32)
    assert isinstance(confirm_depths(views[0], empty, [(views[1], empty)], 2, 0.01), Rejected)
    assert isinstance(confirm_depths(views[0], empty, [], 2, 0.01), Rejected)


def test_region_leaves_strays_out():
    points = np.random.default_rng(0).uniform(-1, 1, (1000, 3))
    points[0] = 500.0
    view = View("v", np.eye(3), np.eye(3), np.zeros(3), 10, 10, np.arange(1000), points)

    low, high = region([view])

    assert np.all((low > -1.5) & (low < -1.2))
    assert np.all((high < 1.5) & (high > 1.2))
