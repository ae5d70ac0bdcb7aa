"""Plain walls are bridged where what is known of them lies on a plane, and nothing else is."""

import numpy as np
import pytest

from sfm_app.stereo.plain_areas import fill_planar_areas

HEIGHT, WIDTH = 240, 320
ROW, COL = np.mgrid[:HEIGHT, :WIDTH]
WALL = 1 / (0.2 + 2e-4 * COL - 1e-4 * ROW)
"""Depth of a slanted wall."""


NO_WALL = np.zeros((HEIGHT, WIDTH), bool)


def paint(texture_from_col: int) -> np.ndarray:
    """A wall of one color, with a pattern beside it."""
    rng = np.random.default_rng(1)
    pattern = rng.integers(0, 255, (HEIGHT // 4, WIDTH // 4)).repeat(4, 0).repeat(4, 1)
    return np.where(texture_from_col > COL, 180 + rng.normal(0, 1, COL.shape), pattern).astype(np.uint8)


def patches(truth: np.ndarray, share: float, noise: float, seed: int = 2) -> np.ndarray:
    """Depths known in scattered squares of 8 pixels."""
    rng = np.random.default_rng(seed)
    known = (rng.random((HEIGHT // 8, WIDTH // 8)) < share).repeat(8, 0).repeat(8, 1)
    rough = truth * (1 + rng.normal(0, noise, (HEIGHT // 8, WIDTH // 8)).repeat(8, 0).repeat(8, 1))
    return np.where(known, rough, 0).astype(np.float32)


@pytest.mark.parametrize("share", [0.2, 0.6])
def test_a_plain_wall_is_found_between_what_is_known_of_it(share):
    depth = patches(WALL, share, noise=0.003)

    found = fill_planar_areas(depth, paint(240), 0.01, NO_WALL)

    wall = (COL > 20) & (COL < 220) & (ROW > 20) & (ROW < 220)
    assert np.mean(depth[wall] > 0) < share + 0.1
    assert np.mean(found[wall] > 0) > 0.98
    error = np.abs(found / WALL - 1)[wall & (found > 0)]
    assert 0 < error.max() < 0.002  # the mean of many rough depths
    beside = COL >= 244
    np.testing.assert_array_equal(found[beside], depth[beside])


def test_nothing_is_carried_beyond_what_is_known():
    depth = np.where(ROW > 120, patches(WALL, 0.5, 0.003), 0).astype(np.float32)

    found = fill_planar_areas(depth, paint(WIDTH), 0.01, NO_WALL)

    assert np.mean(found[130:230] > 0) > 0.9
    assert not found[:118].any()


@pytest.mark.parametrize(
    "truth",
    [
        WALL * (1 + 0.3 * np.random.default_rng(3).random((HEIGHT, WIDTH))),  # what chance agrees on in a sky
        WALL * (1 + 0.02 * ((COL - 160) / 160) ** 2),  # a round column
        np.where(COL < 160, WALL, 1.05 * WALL),  # two walls of one color
    ],
    ids=["chance", "bend", "step"],
)
def test_what_is_no_plane_stays_as_it_is(truth):
    depth = patches(truth, 0.4, 0.001)

    np.testing.assert_array_equal(fill_planar_areas(depth, paint(WIDTH), 0.01, NO_WALL), depth)


def test_a_few_specks_make_no_wall():
    depth = patches(WALL, 0.04, 0.0)

    np.testing.assert_array_equal(fill_planar_areas(depth, paint(WIDTH), 0.01, NO_WALL), depth)


def test_a_sky_beside_a_wall_of_its_color_is_not_filled_unless_it_is_known_to_be_a_wall():
    depth = patches(WALL, 0.5, 0.003)
    depth[:120, 200:] = 0  # what runs out of the photo above the wall, and to its right
    beyond = (COL > 215) & (ROW < 105) & (COL < 320 - 20) & (ROW > 20)

    plain = fill_planar_areas(depth, paint(WIDTH), 0.01, NO_WALL)
    wall = fill_planar_areas(depth, paint(WIDTH), 0.01, np.ones((HEIGHT, WIDTH), bool))

    assert np.mean(plain[beyond] > 0) < 0.02
    assert np.mean(plain[(ROW > 130) & (ROW < 220) & (COL > 20) & (COL < 300)] > 0) > 0.95
    assert np.mean(wall[beyond] > 0) > 0.2, "within the hull"
