"""Depths that spill over outlines."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sfm_app.stereo.outlines import REACH_PX, remove_spill

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

    assert (found[wire] > 0).all()
    assert np.mean(found[seam & ~wire] > 0) < 0.1


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


@pytest.mark.parametrize("sign", [-1, 1])
def test_the_seam_over_a_plain_surface_behind_is_removed(sign):
    behind = np.where(DISC, 0.0, 4.0 + 0.002 * sign * COL).astype(np.float32)
    given_depth = np.where(DISC | SEAM, depths(ROW >= 0), behind)

    found = remove_spill(given_depth, photo(120, 200))

    assert np.mean(found[SEAM] > 0) < 0.05
    np.testing.assert_array_equal(found[DISC], given_depth[DISC])
    np.testing.assert_array_equal(found[~SEAM], given_depth[~SEAM])


def test_an_outline_between_equal_grays_stays():
    given_depth = np.where(DISC, 3.0, 4.0).astype(np.float32)

    assert np.mean(remove_spill(given_depth, photo(150, 150, 1.5)) == given_depth) > 0.995


def test_a_slanted_plane_stays():
    given_depth = (3.0 / (1 - 0.008 * (COL - 40))).astype(np.float32)

    np.testing.assert_array_equal(remove_spill(given_depth, photo(60, 200)), given_depth)


def test_a_seam_over_a_textured_surface_stays():
    """Matching tells where it ends."""
    behind = np.where(DISC, 0.0, 4.0).astype(np.float32)
    given_depth = np.where(DISC | SEAM, depths(ROW >= 0), behind)
    texture = np.random.default_rng(0).integers(160, 240, DISC.shape)
    gray = np.where(DISC, photo(60, 0), texture).astype(np.uint8)

    np.testing.assert_array_equal(remove_spill(given_depth, gray), given_depth)
