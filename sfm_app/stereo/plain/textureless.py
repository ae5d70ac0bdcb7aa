"""Textureless areas of a photo: plain walls, which have a surface, and skies, which have none.

Semi-global matching extends depths from the borders into both kinds of area in the same way in every photo, so photos
taken close to each other agree. They agree across a whole wall, but only along the rim of a sky.
"""

import cv2
import numpy as np
from numpy.typing import NDArray

BLANK_CORRELATION = 0.1
"""Correlation below which photos are unrelated; noise alone reaches half of it."""
SPECK_PX = 5
"""Side of the square for majority voting, because noise correlates by chance in places."""
MIN_SHARE = 0.03
"""Other photos confirm a twelfth or more of a wall, but at most a hundredth of a sky."""

FAR_SHARE = 0.02
"""Distance from the nearest sure depth, in longer sides of the photo, over which semi-global matching carries depths
on. Chosen on `garden` and `ornament`, where it is a hundredth, with `corner` left out."""
LEAST_FAR_PX = 100
"""Fewest pixels farther away that tell a wall from a sky. Chosen by hand."""


def plain_walls(weak: NDArray[np.bool_], confirmed: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Mark areas of weak texture, (H, W), that other photos confirm far from all sure depths, too.

    Args:
        weak: (H, W) where there is hardly any texture.
        confirmed: (H, W) whether enough other photos confirm the depth.
    """
    smooth = cv2.medianBlur(weak.view(np.uint8), SPECK_PX)
    count, areas = cv2.connectedComponents(smooth, connectivity=4)
    sure = confirmed & ~weak
    away = cv2.distanceTransform(1 - sure.view(np.uint8), cv2.DIST_L2, 3)
    far = away > FAR_SHARE * max(weak.shape)
    size = np.bincount(areas[far], minlength=count)
    share = np.bincount(areas[far], confirmed[far], count) / np.maximum(size, 1)
    wall = (size >= LEAST_FAR_PX) & (share >= MIN_SHARE)
    wall[0] = False  # label 0: everything that has texture
    return np.asarray(wall)[areas]


def surfaceless_areas(confidence: NDArray[np.float32], confirmed: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Mark blank areas of which almost nothing is confirmed, (H, W).

    Args:
        confidence: (H, W) in [0, 1], 0 where there is no depth.
        confirmed: (H, W) whether enough other photos confirm the depth.
    """
    blank = cv2.medianBlur((confidence < BLANK_CORRELATION).view(np.uint8), SPECK_PX)
    count, areas = cv2.connectedComponents(blank, connectivity=4)
    size = np.maximum(np.bincount(areas.ravel(), minlength=count), 1)
    share = np.bincount(areas.ravel(), confirmed.ravel(), count) / size
    share[0] = 1.0  # label 0: everything that is not blank
    return np.asarray(share < MIN_SHARE)[areas]
