"""Straight line segments in photos."""

import cv2
import numpy as np
from numpy.typing import NDArray

LONGER_SIDE_PX = 1000
"""Photos are shrunk to this size, which makes edges longer and noise smaller."""

SHORTEST, MOST_SEGMENTS = 0.025, 400
"""Shortest segment as a share of the photo's longer side, and how many of the longest are kept."""


def line_segments(gray: NDArray[np.uint8]) -> NDArray[np.float64]:
    """Find line segments in a gray photo (H, W): (N, 4) x1, y1, x2, y2 in its pixels, longest first.

    Uses LSD (von Gioi, Jakubowicz, Morel and Randall 2010).
    """
    longer = max(gray.shape)
    shrink = min(1.0, LONGER_SIDE_PX / longer)
    size = (max(1, round(gray.shape[1] * shrink)), max(1, round(gray.shape[0] * shrink)))
    small = cv2.resize(gray, size, interpolation=cv2.INTER_AREA) if shrink < 1.0 else gray
    found = cv2.createLineSegmentDetector(cv2.LSD_REFINE_STD).detect(small)[0]
    if found is None:
        return np.zeros((0, 4))
    # OpenCV puts the center of the top-left pixel at 0
    segments = np.asarray(found, np.float64).reshape(-1, 4) + 0.5
    lengths = np.hypot(segments[:, 2] - segments[:, 0], segments[:, 3] - segments[:, 1])
    order = np.argsort(-lengths, kind="stable")[:MOST_SEGMENTS]
    order = order[lengths[order] >= SHORTEST * max(size)]
    return np.asarray(segments[order] * np.tile([gray.shape[1] / size[0], gray.shape[0] / size[1]], 2), np.float64)
