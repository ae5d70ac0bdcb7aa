"""Blank areas are walls or nothing."""

import numpy as np
import pytest

from sfm_app.stereo.plain_areas import FAR_SHARE, plain_walls, surfaceless_areas

SHAPE = (120, 160)


def blank_half(noise: float = 0.0) -> np.ndarray:
    """Nothing to be seen in the upper half, but for some pixels that are alike by chance."""
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
def test_a_sky_that_is_confirmed_along_its_rim_has_no_surface(noise):
    found = surfaceless_areas(blank_half(noise), confirmed_rim(1))

    assert found[:58].mean() > 0.98
    assert not found[62:].any()


@pytest.mark.parametrize("rows", [5, 30, 60])
def test_a_wall_of_which_some_is_confirmed_stays(rows):
    assert not surfaceless_areas(blank_half(), confirmed_rim(rows)).any()


def test_areas_are_told_apart():
    confidence = np.full(SHAPE, 0.9, np.float32)
    confidence[10:50, 10:70] = confidence[10:50, 90:150] = 0.0
    confirmed = np.ones(SHAPE, bool)
    confirmed[10:50, 90:150] = False

    found = surfaceless_areas(confidence, confirmed)

    assert not found[:, :80].any()
    assert found[12:48, 92:148].all()


@pytest.mark.parametrize("confidence", [0.0, 0.9])
def test_photos_that_are_all_alike(confidence):
    everywhere = np.full(SHAPE, confidence, np.float32)

    assert surfaceless_areas(everywhere, np.zeros(SHAPE, bool)).all() == (confidence == 0.0)
    assert not surfaceless_areas(everywhere, np.ones(SHAPE, bool)).any()


def test_weak_likeness_is_not_blank():
    weak = np.full(SHAPE, 0.15, np.float32)

    assert not surfaceless_areas(weak, np.zeros(SHAPE, bool)).any()


def test_a_wall_is_confirmed_in_places_far_from_outlines():
    weak = blank_half() < 0.3
    confirmed = confirmed_rim(2)
    confirmed[10:20, 30:90] = True

    found = plain_walls(weak, confirmed)

    assert found[:58].mean() > 0.98 and not found[62:].any()


@pytest.mark.parametrize("rows", [0, 3])
def test_depths_that_are_carried_on_over_an_outline_make_no_wall(rows):
    assert rows <= FAR_SHARE * max(SHAPE)
    confirmed = confirmed_rim(rows)
    confirmed[5:7, 20:40] = True  # by chance: less than a hundredth

    assert not plain_walls(blank_half() < 0.3, confirmed).any()


def test_a_narrow_strip_tells_nothing():
    weak = np.zeros(SHAPE, bool)
    weak[:, 50:55] = True

    assert not plain_walls(weak, np.ones(SHAPE, bool)).any()
