"""Between known pixels is something else than beside them."""

import numpy as np
import pytest

from sfm_app.stereo.plain_areas import enclosed_pixels

SHAPE = (120, 160)
ROW, COL = np.mgrid[: SHAPE[0], : SHAPE[1]]


def test_a_hole_in_what_is_known_is_enclosed():
    hole = (abs(ROW - 60) < 30) & (abs(COL - 80) < 40)

    assert enclosed_pixels(~hole).all()


def test_what_lies_beyond_an_outline_is_not():
    wall = (COL < 90) & (ROW > 40)

    found = enclosed_pixels(wall)

    assert not found[:30].any() and not found[:, 100:].any()
    assert found[46:, :84][wall[46:, :84]].all()


@pytest.mark.parametrize(("open_side", "expected"), [("top", True), ("corner", False)])
def test_one_side_may_be_open(open_side, expected):
    known = (ROW > 100) | (COL < 20) | (COL > 140) if open_side == "top" else (ROW > 100) | (COL < 20)

    assert enclosed_pixels(known)[50, 80] == expected


def test_specks_enclose_nothing():
    specks = np.zeros(SHAPE, bool)
    specks[::30, ::30] = True

    assert not enclosed_pixels(specks).any()
