"""Walls are filled where their depths lie on a plane; skies and outlines stay open."""

import numpy as np
import pytest

from sfm_app.stereo.plain_areas import OPTIONS, enclosed_pixels, fill_planar_areas, plain_walls, surfaceless_areas

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
def test_a_plain_wall_is_filled_between_its_depths(share):
    depth = patches(WALL, share, noise=0.003)

    filled = fill_planar_areas(depth, paint(240), 0.01, NO_WALL)

    wall = (COL > 20) & (COL < 220) & (ROW > 20) & (ROW < 220)
    assert np.mean(depth[wall] > 0) < share + 0.1
    assert np.mean(filled[wall] > 0) > 0.98
    error = np.abs(filled / WALL - 1)[wall & (filled > 0)]
    assert 0 < error.max() < 0.002  # the mean of many rough depths
    beside = COL >= 244
    np.testing.assert_array_equal(filled[beside], depth[beside])


def test_planes_are_not_extrapolated():
    depth = np.where(ROW > 120, patches(WALL, 0.5, 0.003), 0).astype(np.float32)

    filled = fill_planar_areas(depth, paint(WIDTH), 0.01, NO_WALL)

    assert np.mean(filled[130:230] > 0) > 0.9
    assert not filled[:118].any()


@pytest.mark.parametrize(
    "truth",
    [
        WALL * (1 + 0.3 * np.random.default_rng(3).random((HEIGHT, WIDTH))),  # agreement by chance in a sky
        WALL * (1 + 0.02 * ((COL - 160) / 160) ** 2),  # a round column
        np.where(COL < 160, WALL, 1.05 * WALL),  # two walls of one color
    ],
    ids=["chance", "bend", "step"],
)
def test_no_plane_and_a_few_specks_stay_unchanged(truth):
    for depth in (patches(truth, 0.4, 0.001), patches(WALL, 0.04, 0.0)):
        np.testing.assert_array_equal(fill_planar_areas(depth, paint(WIDTH), 0.01, NO_WALL), depth)


def test_a_sky_of_the_color_of_a_wall_is_filled_only_as_a_wall():
    depth = patches(WALL, 0.5, 0.003)
    depth[:120, 200:] = 0  # above the wall and to its right
    beyond = (COL > 215) & (ROW < 105) & (COL < 320 - 20) & (ROW > 20)

    plain = fill_planar_areas(depth, paint(WIDTH), 0.01, NO_WALL)
    wall = fill_planar_areas(depth, paint(WIDTH), 0.01, np.ones((HEIGHT, WIDTH), bool))

    assert np.mean(plain[beyond] > 0) < 0.02
    assert np.mean(plain[(ROW > 130) & (ROW < 220) & (COL > 20) & (COL < 300)] > 0) > 0.95
    assert np.mean(wall[beyond] > 0) > 0.2, "within the hull"


# Enclosed pixels.

SHAPE = (120, 160)
UP, LEFT = ROW[:120, :160], COL[:120, :160]


def test_a_hole_is_enclosed_and_the_outside_of_an_outline_is_not():
    assert enclosed_pixels((abs(UP - 60) >= 30) | (abs(LEFT - 80) >= 40)).all()
    wall = (LEFT < 90) & (UP > 40)
    enclosed = enclosed_pixels(wall)
    assert not enclosed[:30].any() and not enclosed[:, 100:].any()
    assert enclosed[46:, :84][wall[46:, :84]].all()


def test_one_side_may_be_open():
    corner = (UP > 100) | (LEFT < 20)

    assert enclosed_pixels(corner | (LEFT > 140))[50, 80]
    assert not enclosed_pixels(corner)[50, 80]


def test_specks_enclose_nothing():
    assert not enclosed_pixels((UP % 30 == 0) & (LEFT % 30 == 0)).any()


# Walls and skies.


def blank_half(noise: float = 0.0) -> np.ndarray:
    """A blank upper half, where some pixels correlate by chance."""
    rng = np.random.default_rng(1)
    confidence = np.full(SHAPE, 0.9, np.float32)
    confidence[:60] = np.where(rng.random((60, 160)) < noise, 0.3, 0.04)
    return confidence


def confirmed_rim(rows: int) -> np.ndarray:
    """All of the lower half, and a strip above it."""
    confirmed = np.zeros(SHAPE, bool)
    confirmed[60 - rows :] = True
    return confirmed


@pytest.mark.parametrize("noise", [0.0, 0.1])
def test_a_sky_with_a_confirmed_rim_has_no_surface(noise):
    sky = surfaceless_areas(blank_half(noise), confirmed_rim(1))

    assert sky[:58].mean() > 0.98
    assert not sky[62:].any()


@pytest.mark.parametrize("rows", [5, 30, 60])
def test_a_partly_confirmed_wall_stays(rows):
    assert not surfaceless_areas(blank_half(), confirmed_rim(rows)).any()


def test_areas_are_independent():
    confidence = np.full(SHAPE, 0.9, np.float32)
    confidence[10:50, 10:70] = confidence[10:50, 90:150] = 0.0
    confirmed = np.ones(SHAPE, bool)
    confirmed[10:50, 90:150] = False

    sky = surfaceless_areas(confidence, confirmed)

    assert not sky[:, :80].any()
    assert sky[12:48, 92:148].all()


@pytest.mark.parametrize("confidence", [0.0, 0.15, 0.9])
def test_uniform_photos(confidence):
    """A weak correlation of 0.15 is not blank."""
    everywhere = np.full(SHAPE, confidence, np.float32)

    assert surfaceless_areas(everywhere, np.zeros(SHAPE, bool)).all() == (confidence == 0.0)
    assert surfaceless_areas(everywhere, np.zeros(SHAPE, bool)).any() == (confidence == 0.0)
    assert not surfaceless_areas(everywhere, np.ones(SHAPE, bool)).any()


def test_a_wall_is_confirmed_in_places_far_from_outlines():
    weak = blank_half() < 0.3
    confirmed = confirmed_rim(2)
    confirmed[10:20, 30:90] = True

    wall = plain_walls(weak, confirmed)

    assert wall[:58].mean() > 0.98 and not wall[62:].any()


@pytest.mark.parametrize("rows", [0, 3])
def test_depths_near_an_outline_make_no_wall(rows):
    assert rows <= OPTIONS.far_share * max(SHAPE)
    confirmed = confirmed_rim(rows)
    confirmed[5:7, 20:40] = True  # by chance: less than a hundredth

    assert not plain_walls(blank_half() < 0.3, confirmed).any()


def test_a_narrow_strip_is_no_wall():
    weak = np.zeros(SHAPE, bool)
    weak[:, 50:55] = True

    assert not plain_walls(weak, np.ones(SHAPE, bool)).any()
