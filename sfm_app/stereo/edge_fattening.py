"""Depths that spill over the outline of a thing onto what is beside it."""

import cv2
import numpy as np
from numpy.typing import NDArray

from sfm_app.stereo.patch_match import BORDER
from sfm_app.stereo.view import DepthArray, GrayImage

REACH_PX = BORDER + 1
"""A window with its middle so far beside an outline still holds a pixel of it; where there is nothing else to be seen,
that pixel alone decides."""
SURROUNDINGS_PX = 4 * REACH_PX + 1
"""Side of the square around a pixel in which it is compared with what has a depth and what has none."""
NOISE_GRAY = 3.0
"""Least standard deviation of grays: noise, and traces of compression."""
ODDS = 8.0
"""So many times more likely has a pixel's gray to be among those without a depth than among those with one."""
LEAST_PX = 5
"""Pixels that say what the surroundings look like."""
ANY_GRAY = 0.5 * np.log(2.0 * np.pi) - np.log(256.0)
"""Log likelihood of a gray where nothing is known: all are alike. Things as thin as their rims are such."""


def without_spill(depth: DepthArray, image: GrayImage) -> DepthArray:
    """Return the depth map without rims that look like the empty side, not like the surface that they continue.

    Skies and plain backgrounds have no depth of their own, but a window of correlation that reaches a thing in front
    of them finds that thing's: a seam as wide as half the window, in every photo alike, so that no check between photos
    takes it off. The pixels themselves tell: grays with a depth, away from the rim, and grays without one are each
    taken as normally distributed around a pixel. Next to gaps in a plain surface both look the same, and nothing goes;
    nor does it next to gaps narrower than two rims, which lie in surfaces rather than beside them.

    Args:
        depth: (H, W), 0 where unknown.
        image: (H, W).
    """
    known = depth > 0
    empty, rim = _broad(~known), rims(known)
    gray = image.astype(np.float32)
    thing = _log_likelihood(gray, known & ~rim)
    spilt = _log_likelihood(gray, empty) > np.where(np.isnan(thing), ANY_GRAY, thing) + np.log(ODDS)
    return np.where(spilt & rim, np.float32(0), depth)


def rims(known: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return (H, W) the pixels with a depth that lie within `REACH_PX` of an empty place broader than two rims."""
    away = cv2.distanceTransform(1 - _broad(~known).view(np.uint8), cv2.DIST_L2, 3)
    return np.asarray(known & (away <= REACH_PX))


def _broad(empty: NDArray[np.bool_]) -> NDArray[np.bool_]:
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * REACH_PX + 1, 2 * REACH_PX + 1))
    return np.asarray(cv2.morphologyEx(empty.view(np.uint8), cv2.MORPH_OPEN, disc)).view(np.bool_)


def _log_likelihood(gray: NDArray[np.float32], among: NDArray[np.bool_]) -> NDArray[np.float32]:
    """Return (H, W) of each pixel's gray among the marked pixels around it.

    Nan, which compares as false, if there are few.
    """
    side = (SURROUNDINGS_PX, SURROUNDINGS_PX)
    marked = among.astype(np.float32)
    count = cv2.blur(marked, side)
    enough = count * SURROUNDINGS_PX**2 > LEAST_PX - 0.5
    share = np.where(enough, count, np.float32(np.nan))
    mean = cv2.blur(gray * marked, side) / share
    variance = np.maximum(cv2.blur(gray * gray * marked, side) / share - mean * mean, 0.0) + NOISE_GRAY**2
    return np.asarray(-0.5 * ((gray - mean) ** 2 / variance + np.log(variance)), np.float32)
