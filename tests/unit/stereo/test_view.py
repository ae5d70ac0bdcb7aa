"""Neighbors of photos, and the bounds of their points."""

import numpy as np
import pytest

from sfm_app.stereo.view import BEST_ANGLE_DEG, View, point_weights, rank_neighbors, region


def view_at(center, points, ids=None, focal=500.0) -> View:
    ids = np.arange(len(points)) if ids is None else np.asarray(ids)
    K = np.array([[focal, 0, 320], [0, focal, 240], [0, 0, 1]])
    return View("v", K, np.column_stack([np.eye(3), -np.array(center, float)]), 640, 480, ids, points[ids])


@pytest.fixture
def points() -> np.ndarray:
    rng = np.random.default_rng(0)
    return np.column_stack([rng.uniform(-1, 1, (100, 2)), rng.uniform(9, 11, 100)])


def test_prefers_good_angles_to_narrow_and_wide_ones(points):
    best = 10 * np.tan(np.radians(BEST_ANGLE_DEG))
    views = [view_at((x, 0, 0), points) for x in (0.0, 0.02 * best, best, 6 * best)]

    assert rank_neighbors(views, 1)[0] == [2]


def test_neighbors_cover_both_sides_of_the_photo(points):
    left, right = np.flatnonzero(points[:, 0] < 0), np.flatnonzero(points[:, 0] >= 0)
    right = right[: int(0.8 * len(left))]
    views = [
        view_at((0, 0, 0), points),
        view_at((1.4, 0, 0), points, left),
        view_at((1.41, 0, 0), points, left),
        view_at((-1.4, 0, 0), points, right),
    ]

    ranked = rank_neighbors(views, 2)[0]

    assert ranked[0] in (1, 2)
    assert ranked[1] == 3


def test_views_without_common_points_and_the_view_itself_are_no_neighbors(points):
    views = [view_at((0, 0, 0), points, range(50)), view_at((1, 0, 0), points, range(48, 100))]

    assert rank_neighbors(views, 4) == [[], []]


def test_weights_fall_with_differing_scale_and_vanish_behind_a_camera(points):
    view = view_at((0, 0, 0), points)
    same, zoomed = view_at((1.4, 0, 0), points), view_at((1.4, 0, 0), points, focal=1500.0)

    np.testing.assert_allclose(point_weights(view, zoomed, points), point_weights(view, same, points) / 3, rtol=1e-9)
    assert not point_weights(view, view_at((1.4, 0, 20), points), points).any()
    assert np.all((point_weights(view, same, points) > 0.5) & (point_weights(view, same, points) <= 1))


def test_region_ignores_outliers():
    points = np.random.default_rng(0).uniform(-1, 1, (1000, 3))
    points[0] = 500.0

    low, high = region([view_at((0, 0, 0), points)])

    assert np.all((low > -1.5) & (low < -1.2))
    assert np.all((high < 1.5) & (high > 1.2))
