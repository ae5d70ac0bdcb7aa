"""Depths of an object that spill over its outline onto the background."""

import cv2
import numpy as np
from numpy.typing import NDArray

from sfm_app.stereo.patch_match import BORDER
from sfm_app.stereo.view import DepthArray, GrayImage

REACH_PX = BORDER + 1
"""A window centered this far from an outline still contains a pixel of it; on a textureless background that pixel
alone decides."""
SURROUNDINGS_PX = 4 * REACH_PX + 1
"""Side of the square around a pixel that is compared with it: pixels with a depth, and pixels without one."""
NOISE_GRAY = 3.0
"""Smallest standard deviation of gray levels: sensor noise and compression artifacts."""
MIN_ODDS = 8.0
"""Smallest likelihood ratio of a pixel's gray, pixels without a depth over pixels with one, that removes its depth."""
LEAST_PX = 5
"""Fewest pixels that determine the gray distribution of the surroundings."""
UNIFORM_LOG_LIKELIHOOD = 0.5 * np.log(2.0 * np.pi) - np.log(256.0)
"""Log likelihood of a gray under the uniform distribution, for objects so thin that they consist of rim only."""


def remove_spill(depth: DepthArray, image: GrayImage) -> DepthArray:
    """Remove rim depths whose gray resembles the empty side rather than the surface that they extend.

    Skies and plain backgrounds have no depth of their own, but a correlation window that reaches an object in front
    of them finds the object's depth. The result is a seam half a window wide. It is the same in every photo, so no
    check between photos removes it. The gray levels decide: around a pixel, those with a depth, away from the rim, and
    those without one are each modeled as normally distributed. Next to gaps in a plain surface both distributions are
    the same, and nothing is removed. Gaps narrower than two rims are ignored: they lie within surfaces.

    Args:
        depth: (H, W), 0 where unknown.
        image: (H, W).
    """
    known = depth > 0
    empty, rim = _broad_areas(~known), rim_mask(known)
    gray = image.astype(np.float32)
    thing = _log_likelihood(gray, known & ~rim)
    spilt = _log_likelihood(gray, empty) > np.where(np.isnan(thing), UNIFORM_LOG_LIKELIHOOD, thing) + np.log(MIN_ODDS)
    return np.where(spilt & rim, np.float32(0), depth)


def rim_mask(known: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Mark pixels with a depth within `REACH_PX` of a gap that is broader than two rims, (H, W)."""
    away = cv2.distanceTransform(1 - _broad_areas(~known).view(np.uint8), cv2.DIST_L2, 3)
    return np.asarray(known & (away <= REACH_PX))


def _broad_areas(empty: NDArray[np.bool_]) -> NDArray[np.bool_]:
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * REACH_PX + 1, 2 * REACH_PX + 1))
    return np.asarray(cv2.morphologyEx(empty.view(np.uint8), cv2.MORPH_OPEN, disc)).view(np.bool_)


def _log_likelihood(gray: NDArray[np.float32], among: NDArray[np.bool_]) -> NDArray[np.float32]:
    """Return (H, W) log likelihood of each pixel's gray, given the marked pixels around it.

    NaN, which compares as false, where too few are marked.
    """
    side = (SURROUNDINGS_PX, SURROUNDINGS_PX)
    marked = among.astype(np.float32)
    count = cv2.blur(marked, side)
    enough = count * SURROUNDINGS_PX**2 > LEAST_PX - 0.5
    share = np.where(enough, count, np.float32(np.nan))
    mean = cv2.blur(gray * marked, side) / share
    variance = np.maximum(cv2.blur(gray * gray * marked, side) / share - mean * mean, 0.0) + NOISE_GRAY**2
    return np.asarray(-0.5 * ((gray - mean) ** 2 / variance + np.log(variance)), np.float32)
