"""Areas of a photo in which nothing can be seen: plain walls, or skies and what else has no surface.

Semi-global matching carries depths from their borders into both, in every photo alike, so that photos taken close to
each other agree. They agree across a wall as a whole, but only along the rim of a sky: an area is one or the other.
"""

import cv2
import numpy as np
from numpy.typing import NDArray

BLANK = 0.1
"""Correlation below which photos have nothing in common; noise alone reaches half of it."""
SPECK_PX = 5
"""Side of the square whose majority decides; noise correlates by chance here and there."""
MIN_SHARE = 0.03
"""Of walls, other photos confirm a twelfth and more; of skies, a hundredth at most."""


def without_surface(confidence: NDArray[np.float32], confirmed: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return (H, W) the blank areas next to nothing of which is confirmed.

    Args:
        confidence: (H, W) in [0, 1], 0 where there is no depth.
        confirmed: (H, W) whether enough other photos confirm the depth.
    """
    blank = cv2.medianBlur((confidence < BLANK).view(np.uint8), SPECK_PX)
    count, areas = cv2.connectedComponents(blank, connectivity=4)
    size = np.maximum(np.bincount(areas.ravel(), minlength=count), 1)
    share = np.bincount(areas.ravel(), confirmed.ravel(), count) / size
    share[0] = 1.0  # all that is not blank
    return np.asarray(share < MIN_SHARE)[areas]
