"""Depths that spill over outlines."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sfm_app.stereo.patch_match import REACH_PX, remove_spill, rim_mask

SIDE = 80
ROW, COL = np.indices((SIDE, SIDE))
DISC = np.hypot(ROW - 40, COL - 40) < 22
SEAM = (np.hypot(ROW - 40, COL - 40) < 22 + REACH_PX - 1) & ~DISC


def photo(inside, outside, spread=2.0, seed=0):
    """A disc of one mean gray on another, with noise or texture of a standard deviation in it."""
    rng = np.random.default_rng(seed)
    gray = np.where(DISC, rng.normal(inside, spread, DISC.shape), rng.normal(outside, 1.5, DISC.shape))
    return np.clip(np.rint(gray), 0, 255).astype(np.uint8)


def depths(known):
    return np.where(known, 3.0 + 0.001 * COL, 0.0).astype(np.float32)


@pytest.mark.parametrize(("inside", "outside", "spread"), [(120, 200, 2), (200, 180, 3), (60, 10, 15), (150, 215, 25)])
def test_the_seam_around_a_thing_goes_and_the_thing_stays(inside, outside, spread):
    given_depth = depths(DISC | SEAM)

    found = remove_spill(given_depth, photo(inside, outside, spread))

    assert np.mean(found[SEAM] > 0) < 0.05
    assert np.mean(found[DISC] > 0) > 0.98
    np.testing.assert_array_equal(found[found > 0], given_depth[found > 0])


def test_a_true_outline_stays_as_it_is():
    found = remove_spill(depths(DISC), photo(120, 200, 15))

    assert np.mean(found[DISC] > 0) > 0.995


def test_nothing_goes_around_a_hole_in_a_surface_of_one_look():
    known = ~DISC

    found = remove_spill(depths(known), photo(150, 150, 1.5))

    assert np.mean(found[known] > 0) > 0.995


def test_a_narrow_gap_lies_in_a_surface_and_keeps_its_rim():
    crack = np.abs(COL - 40) < REACH_PX
    gray = np.where(np.abs(COL - 40) < REACH_PX + 4, 60, 200).astype(np.uint8)

    np.testing.assert_array_equal(remove_spill(depths(~crack), gray), depths(~crack))
    broad = np.abs(COL - 40) <= REACH_PX + 1
    assert np.all(remove_spill(depths(~broad), gray)[np.abs(COL - 40) < REACH_PX + 4] == 0)


def test_what_is_thin_keeps_what_does_not_look_like_the_empty_side():
    wire, seam = np.abs(COL - 40) <= 1, np.abs(COL - 40) < REACH_PX
    gray = photo(200, 200)
    gray[wire] = 120

    found = remove_spill(depths(seam), gray)

    np.testing.assert_array_equal(found > 0, wire)


def test_rims_lie_beside_what_is_broadly_empty():
    away = np.abs(COL - 20) - 2 * REACH_PX  # of the columns to the right of a gap four rims wide

    found = rim_mask((away > 0) & (np.abs(COL - 60) > 1))

    np.testing.assert_array_equal(found, (away > 0) & (away <= REACH_PX))


@given(st.integers(0, 2**32 - 1), st.floats(0, 1))
def test_depths_are_kept_or_dropped_and_never_far_from_nothing(seed, share):
    rng = np.random.default_rng(seed)
    known = np.repeat(np.repeat(rng.random((4, 4)) < share, 20, 0), 20, 1)
    given_depth = depths(known)

    found = remove_spill(given_depth, rng.integers(0, 256, known.shape).astype(np.uint8))

    dropped = (found == 0) & known
    np.testing.assert_array_equal(found[~dropped], given_depth[~dropped])
    rows, cols = np.nonzero(~known)
    for row, col in np.argwhere(dropped)[:50]:
        assert np.hypot(rows - row, cols - col).min() <= REACH_PX + 0.5


@pytest.mark.parametrize("known", [np.zeros((SIDE, SIDE), bool), np.ones((SIDE, SIDE), bool)])
def test_all_or_nothing_stays(known):
    np.testing.assert_array_equal(remove_spill(depths(known), photo(120, 200)), depths(known))
