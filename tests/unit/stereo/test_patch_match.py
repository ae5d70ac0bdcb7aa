"""Planes per pixel and their normals."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sfm_app.stereo.patch_match import NO_MATCH, fit_planes, match_planes, plane_normals
from sfm_app.stereo.view import View

CENTERS = [(0.5, 0, 0), (-0.4, 0.2, 0), (0, 0.5, 0.3)]


@pytest.fixture(scope="module")
def setting(plane, make_view):
    """A view, its photo, and three neighbors with their photos."""
    view = make_view((0, 0, 0))
    others = [make_view(center, turn=(0.02, -0.03, 0.05)) for center in CENTERS]
    return view, plane.photo(view), [(other, plane.photo(other)) for other in others]


@pytest.fixture(scope="module")
def seeds(plane, setting):
    """(1, H, W) the true depth in every tenth row; nothing elsewhere."""
    depths = np.zeros((1, *setting[1].shape), np.float32)
    depths[0, 10::10, 10:-10] = plane.depth(setting[0])[10::10, 10:-10]
    return depths


@pytest.mark.slow
def test_the_plane_spreads_from_seeds(plane, setting, seeds):
    planes, cost = match_planes(seeds, *setting)

    inside = np.zeros(cost.shape, bool)
    inside[25:-25, 45:-45] = True
    known = inside & (cost < 0.5)
    error = np.abs(planes[..., 0] * plane.depth(setting[0]) - 1)[known]
    assert known.sum() > 0.95 * inside.sum()
    assert 1e-5 < np.median(error) < 4e-3  # 0.1 px of a disparity of 28 px


@pytest.mark.slow
def test_wrong_depths_are_costly(plane, setting):
    depths = np.zeros((1, *setting[1].shape), np.float32)
    depths[0, :, :120] = plane.depth(setting[0])[:, :120] / 2.0

    planes, cost = match_planes(depths, *setting)

    wrong = planes[..., 0] * plane.depth(setting[0]) > 1.2
    assert wrong.sum() > 1000
    assert np.median(cost[wrong]) > 0.5
    assert np.all(cost[planes[..., 0] == 0] == NO_MATCH)


@pytest.mark.slow
@pytest.mark.parametrize("right", [0, 1, 2])
def test_the_photos_choose_the_right_one_of_several_guesses(plane, setting, right):
    depth = plane.depth(setting[0]).astype(np.float32)
    checkered = np.indices(depth.shape).sum(axis=0) % 8 < 4
    guesses = np.stack([factor * depth * checkered for factor in (0.7, 1.3, 0.8)])
    guesses[right] = 1.002 * depth * checkered

    planes, cost = match_planes(guesses, *setting)

    inside = np.zeros(cost.shape, bool)
    inside[25:-25, 45:-45] = True
    error = np.abs(planes[..., 0] * depth - 1)[inside & (cost < 0.5)]
    assert len(error) > 0.95 * inside.sum()
    assert 1e-5 < np.median(error) < 4e-3
    assert np.mean(error > 0.02) < 0.02


@pytest.mark.slow
def test_a_flat_photo_correlates_with_nothing_and_one_hidden_view_does_not_matter(setting, seeds):
    view, photo, others = setting
    hidden = [(others[0][0], np.zeros_like(others[0][1])), *others[1:]]

    assert np.all(match_planes(seeds, view, np.full_like(photo, 128), others)[1] >= 0.95)
    assert np.median(match_planes(seeds, view, photo, hidden)[1][30:-30, 50:-50]) < 0.3


# Planes through depth maps.

slope = st.floats(-1.0, 1.0)


def view_with(fx=100.0, fy=100.0, skew=0.0, sample_px=0.5) -> View:
    K = np.array([[fx, skew, 15], [0, fy, 10], [0, 0, 1]])
    return View("v", K, np.eye(3, 4), 30, 20, sample_px=sample_px)


def plane_depth(view: View, normal: np.ndarray, distance: float) -> np.ndarray:
    y, x = np.mgrid[:20, :30] + view.sample_px
    rays = np.stack([x, y, np.ones_like(x)], axis=-1) @ np.linalg.inv(view.K).T
    return (distance / (rays @ normal)).astype(np.float32)


@settings(max_examples=30)
@given(a=slope, b=slope, skew=st.floats(-20, 20), sample_px=st.sampled_from([0.0, 0.5]))
def test_a_plane_comes_back_exactly(a, b, skew, sample_px):
    view = view_with(100.0, 140.0, skew, sample_px)
    normal = np.array([a, b, 3.0]) / np.linalg.norm([a, b, 3.0])
    depth = plane_depth(view, normal, 5.0)

    planes = fit_planes(depth)
    normals = plane_normals(planes, view)

    np.testing.assert_allclose(planes[..., 0] * depth, 1, rtol=2e-6)
    np.testing.assert_allclose(normals, np.broadcast_to(-normal, normals.shape), atol=1e-3)


def test_noise_is_reduced():
    view = view_with()
    depth = plane_depth(view, np.array([0, 0, 1.0]), 5.0)
    noisy = depth + np.random.default_rng(0).normal(0, 0.01, depth.shape).astype(np.float32)

    planes = fit_planes(noisy)

    inside = (1 / planes[..., 0] - depth)[5:-5, 5:-5]
    assert 0.0005 < inside.std() < 0.003


def test_steps_stay_sharp():
    view = view_with()
    depth = np.full((20, 30), 5.0, np.float32)
    depth[:, 15:] = 6.0

    planes = fit_planes(depth)

    np.testing.assert_allclose(planes[..., 0] * depth, 1, rtol=1e-6)
    np.testing.assert_allclose(plane_normals(planes, view)[..., 2], -1.0, atol=1e-5)


def test_specks_and_empty_pixels_get_nothing():
    depth = np.zeros((20, 30), np.float32)
    depth[10, 10:13] = 5.0

    planes = fit_planes(depth)

    assert not planes.any()
    assert not plane_normals(planes, view_with()).any()
