"""SIFT descriptors of a small picture, for photos whose own features are not SIFT."""

import cv2
import numpy as np
from numpy.typing import NDArray

LONGER_SIDE_PX = 1000
"""Large features are seen in a small picture, too."""


def describe_picture(pixels: NDArray[np.uint8], most: int) -> NDArray[np.uint8]:
    """Return (N, 128) descriptors of a picture, those of the largest features first.

    Args:
        pixels: (H, W, 3) RGB.
        most: number of descriptors.
    """
    gray = cv2.cvtColor(pixels, cv2.COLOR_RGB2GRAY)
    scale = LONGER_SIDE_PX / max(gray.shape)
    if scale < 1.0:
        gray = cv2.resize(gray, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    keypoints, descriptors = cv2.SIFT.create().detectAndCompute(gray, None)
    if descriptors is None:
        return np.zeros((0, 128), np.uint8)
    order = np.argsort([-point.size for point in keypoints], kind="stable")[:most]
    return np.asarray(np.clip(np.rint(descriptors[order]), 0, 255), np.uint8)
