"""Which depths other photos confirm."""

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from sfm_app.jit import kernel
from sfm_app.stereo.view import DepthArray, FloatArray, View

MIN_PATCH = 2e-4
"""Smallest patch kept, as a share of the photo: wrong depths agree by chance, but not over a connected area."""
LEVELS = 16
"""Integer levels per tolerance when depths are quantized for the speckle filter."""


def merge_hypotheses(
    depths: NDArray[np.float32], parallaxes: NDArray[np.float32], tolerance: float
) -> tuple[DepthArray, NDArray[np.uint8]]:
    """Fuse the depths from all neighbors into one depth per pixel.

    At each pixel, the largest-weight group of depths within the tolerance of one of them wins and is averaged. The
    weight of a depth is its squared parallax, which is inversely proportional to its variance.

    Args:
        depths: (N, H, W), 0 where unknown.
        parallaxes: (N, H, W) in pixels.
        tolerance: largest relative difference of depths that agree.

    Returns:
        (H, W) depth, 0 where no neighbor has one, and (H, W) number of neighbors that agree with it.
    """
    depth = np.zeros(depths.shape[1:], np.float32)
    support = np.zeros(depths.shape[1:], np.uint8)
    _merge(depths, parallaxes, tolerance, depth, support)
    return depth, support


@kernel
def _merge(
    depths: NDArray[np.float32],
    parallaxes: NDArray[np.float32],
    tolerance: float,
    depth: DepthArray,
    support: NDArray[np.uint8],
) -> None:
    count, height, width = depths.shape
    for row in range(height):
        for col in range(width):
            heaviest = 0.0
            for i in range(count):
                z = depths[i, row, col]
                if z <= 0:
                    continue
                weight, mean, members = 0.0, 0.0, 0
                for j in range(count):
                    other = depths[j, row, col]
                    if other > 0 and abs(other - z) <= tolerance * z:
                        w = parallaxes[j, row, col] ** 2
                        weight += w
                        mean += w / other  # disparity noise is inverse-depth noise
                        members += 1
                if weight > heaviest:
                    heaviest = weight
                    depth[row, col] = weight / mean
                    support[row, col] = members


def count_confirming_maps(
    view: View, depth: DepthArray, others: Sequence[tuple[View, DepthArray]], tolerance: float
) -> NDArray[np.uint8]:
    """Count the other depth maps that confirm each depth of a view, (H, W).

    A map confirms a point if the point's depth in the other view is within the tolerance of the map's depth there.

    Args:
        view: the photo.
        depth: (H, W) of the photo; 0 where unknown.
        others: other photos with their depth maps.
        tolerance: largest relative difference in depth.
    """
    return _count_maps(view, depth, others, (1.0 - tolerance, 1.0 + tolerance))


def count_deeper_maps(
    view: View, depth: DepthArray, others: Sequence[tuple[View, DepthArray]], tolerance: float
) -> NDArray[np.uint8]:
    """Count the other depth maps that see something behind each depth of a view, (H, W), so that it is not there.

    Args:
        view: the photo.
        depth: (H, W) of the photo; 0 where unknown.
        others: other photos with their depth maps.
        tolerance: smallest relative difference in depth.
    """
    return _count_maps(view, depth, others, (1.0 + tolerance, np.inf))


def _count_maps(
    view: View, depth: DepthArray, others: Sequence[tuple[View, DepthArray]], limits: tuple[float, float]
) -> NDArray[np.uint8]:
    """Count the maps whose depth, divided by that of the point in the other view, lies between two positive limits."""
    count = np.zeros(depth.shape, np.uint8)
    K_inv = np.linalg.inv(view.K)
    for other, other_depth in others:
        relative = other.R @ view.R.T
        P = other.K @ np.column_stack([relative @ K_inv, other.t - relative @ view.t])
        _count(depth, other_depth, P, limits, view.sample_px, count)
    return count


def filter_speckles(depth: DepthArray, tolerance: float) -> DepthArray:
    """Remove small patches in which depths differ by less than the tolerance from pixel to pixel.

    Args:
        depth: (H, W); 0 where unknown.
        tolerance: relative difference in depth.
    """
    known = depth > 0
    if not known.any():
        return depth
    logarithm = np.log(np.where(known, depth, depth[known].min()), dtype=np.float32)
    levels = 1 + (logarithm - logarithm.min()) * (LEVELS / tolerance)
    # OpenCV needs 16 bits; depths beyond that range share one level
    patches = np.where(known, np.clip(levels, 1, 32000), -32000).astype(np.int16)
    cv2.filterSpeckles(patches, -32000, int(MIN_PATCH * depth.size), LEVELS)
    return np.where(patches > 0, depth, np.float32(0))


@kernel
def _count(
    depth: DepthArray,
    other_depth: DepthArray,
    P: FloatArray,
    limits: tuple[float, float],
    sample_px: float,
    count: NDArray[np.uint8],
) -> None:
    height, width = other_depth.shape
    for row in range(depth.shape[0]):
        for col in range(depth.shape[1]):
            z = depth[row, col]
            if z <= 0:
                continue
            x, y = col + sample_px, row + sample_px
            w = z * (P[2, 0] * x + P[2, 1] * y + P[2, 2]) + P[2, 3]
            if w <= 0:
                continue
            u = (z * (P[0, 0] * x + P[0, 1] * y + P[0, 2]) + P[0, 3]) / w
            v = (z * (P[1, 0] * x + P[1, 1] * y + P[1, 2]) + P[1, 3]) / w
            j, i = int(np.floor(u - sample_px + 0.5)), int(np.floor(v - sample_px + 0.5))
            if 0 <= i < height and 0 <= j < width and limits[0] * w <= other_depth[i, j] <= limits[1] * w:
                count[row, col] += 1
