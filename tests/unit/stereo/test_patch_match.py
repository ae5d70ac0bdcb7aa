"""Planes per pixel and their normals; depths that spill over outlines."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sfm_app.stereo.patch_match import (
    NO_MATCH,
    REACH_PX,
    fit_planes,
    improve_planes,
    plane_normals,
    remove_spill,
    rim_mask,
)
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
    """The true inverse depth, level, in every tenth row; nothing elsewhere."""
    planes = np.zeros((*setting[1].shape, 3), np.float32)
    planes[10::10, 10:-10, 0] = 1 / plane.depth(setting[0])[10::10, 10:-10]
    return planes


@pytest.mark.slow
def test_the_plane_spreads_from_seeds(plane, setting, seeds):
    planes = seeds.copy()
    cost = improve_planes(planes, *setting)

    inside = np.zeros(cost.shape, bool)
    inside[25:-25, 45:-45] = True
    known = inside & (cost < 0.5)
    error = np.abs(planes[..., 0] * plane.depth(setting[0]) - 1)[known]
    assert known.sum() > 0.95 * inside.sum()
    assert 1e-5 < np.median(error) < 4e-3  # 0.1 px of a disparity of 28 px


@pytest.mark.slow
def test_wrong_depths_are_costly(plane, setting):
    planes = np.zeros((*setting[1].shape, 3), np.float32)
    planes[:, :120, 0] = 2.0 / plane.depth(setting[0])[:, :120]

    cost = improve_planes(planes, *setting)

    wrong = planes[..., 0] * plane.depth(setting[0]) > 1.2
    assert wrong.sum() > 1000
    assert np.median(cost[wrong]) > 0.5
    assert np.all(cost[planes[..., 0] == 0] == NO_MATCH)


@pytest.mark.slow
def test_a_flat_photo_correlates_with_nothing_and_one_hidden_view_does_not_matter(setting, seeds):
    view, photo, others = setting
    hidden = [(others[0][0], np.zeros_like(others[0][1])), *others[1:]]

    assert np.all(improve_planes(seeds.copy(), view, np.full_like(photo, 128), others) >= 0.95)
    assert np.median(improve_planes(seeds.copy(), view, photo, hidden)[30:-30, 50:-50]) < 0.3


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


# Spill over outlines.

SIDE = 80
ROW, COL = np.indices((SIDE, SIDE))
DISC = np.hypot(ROW - 40, COL - 40) < 22
SEAM = (np.hypot(ROW - 40, COL - 40) < 22 + REACH_PX - 1) & ~DISC


def photo(inside, outside, spread=2.0, seed=0):
    """A disc of one mean gray on another; `spread` is the standard deviation of its texture."""
    rng = np.random.default_rng(seed)
    gray = np.where(DISC, rng.normal(inside, spread, DISC.shape), rng.normal(outside, 1.5, DISC.shape))
    return np.clip(np.rint(gray), 0, 255).astype(np.uint8)


def depths(known):
    return np.where(known, 3.0 + 0.001 * COL, 0.0).astype(np.float32)


@pytest.mark.parametrize(("inside", "outside", "spread"), [(120, 200, 2), (200, 180, 3), (60, 10, 15), (150, 215, 25)])
def test_the_seam_around_an_object_is_removed(inside, outside, spread):
    given_depth = depths(DISC | SEAM)

    found = remove_spill(given_depth, photo(inside, outside, spread))

    assert np.mean(found[SEAM] > 0) < 0.05
    assert np.mean(found[DISC] > 0) > 0.98
    np.testing.assert_array_equal(found[found > 0], given_depth[found > 0])


@pytest.mark.parametrize(("known", "gray"), [(DISC, photo(120, 200, 15)), (~DISC, photo(150, 150, 1.5))])
def test_a_true_outline_and_a_hole_in_a_uniform_surface_stay(known, gray):
    assert np.mean(remove_spill(depths(known), gray)[known] > 0) > 0.995


def test_only_broad_gaps_lose_their_rim():
    crack = np.abs(COL - 40) < REACH_PX
    gray = np.where(np.abs(COL - 40) < REACH_PX + 4, 60, 200).astype(np.uint8)

    np.testing.assert_array_equal(remove_spill(depths(~crack), gray), depths(~crack))
    broad = np.abs(COL - 40) <= REACH_PX + 1
    assert np.all(remove_spill(depths(~broad), gray)[np.abs(COL - 40) < REACH_PX + 4] == 0)


def test_a_wire_unlike_the_background_stays():
    wire, seam = np.abs(COL - 40) <= 1, np.abs(COL - 40) < REACH_PX
    gray = photo(200, 200)
    gray[wire] = 120

    found = remove_spill(depths(seam), gray)

    np.testing.assert_array_equal(found > 0, wire)


def test_rims_lie_beside_broad_gaps():
    away = np.abs(COL - 20) - 2 * REACH_PX  # of the columns to the right of a gap four rims wide

    found = rim_mask((away > 0) & (np.abs(COL - 60) > 1))

    np.testing.assert_array_equal(found, (away > 0) & (away <= REACH_PX))


@given(st.integers(0, 2**32 - 1), st.floats(0, 1))
def test_only_depths_near_a_gap_are_dropped(seed, share):
    rng = np.random.default_rng(seed)
    known = np.repeat(np.repeat(rng.random((4, 4)) < share, 20, 0), 20, 1)
    given_depth = depths(known)

    found = remove_spill(given_depth, rng.integers(0, 256, known.shape).astype(np.uint8))

    dropped = (found == 0) & known
    np.testing.assert_array_equal(found[~dropped], given_depth[~dropped])
    rows, cols = np.nonzero(~known)
    for row, col in np.argwhere(dropped)[:50]:
        assert np.hypot(rows - row, cols - col).min() <= REACH_PX + 0.5


@pytest.mark.parametrize("known", [ROW < 0, ROW >= 0])
def test_an_empty_and_a_full_map_stay(known):
    np.testing.assert_array_equal(remove_spill(depths(known), photo(120, 200)), depths(known))
