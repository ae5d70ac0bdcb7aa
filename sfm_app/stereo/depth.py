"""The depth map of a photo: matched with neighboring photos, then checked against their depth maps."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from sfm_app.jit import kernel
from sfm_app.stereo.patch_match import NO_MATCH, fit_planes, match_planes, plane_normals
from sfm_app.stereo.plain_areas import enclosed_pixels, fill_planar_areas, plain_walls, surfaceless_areas
from sfm_app.stereo.rectify import depths_from_disparities, disparities, rectify
from sfm_app.stereo.view import DepthEstimate, DepthMap, GrayImage, View
from sfm_app.types import Rejected
from sfm_app.types.arrays import DepthArray, FloatArray


@dataclass(frozen=True, slots=True)
class DepthOptions:
    """When a depth counts as confirmed."""

    min_patch: float = 2e-4
    """Smallest patch, as a share of the photo: wrong depths agree by chance, but not over a connected area."""
    weak_correlation: float = 0.3
    """Correlation without texture. In skies, depths agree by chance; on plain walls, semi-global matching interpolates
    in the same way in every photo."""
    weak_extra_maps: int = 3
    """Additional depth maps that must agree at a weak correlation; with too few maps, the depth is dropped."""
    unsure_correlation: float = 0.5
    """Correlation below which one more depth map must agree."""
    clipped_gray: int = 4
    """Gray levels from black or white within which pixels are clipped: their depths come from neighboring pixels."""


OPTIONS = DepthOptions()


def match_depths(
    view: View, candidates: Sequence[View], load: Callable[[View], GrayImage], count: int
) -> DepthEstimate | Rejected:
    """Match a photo with the first `count` candidates that can be rectified with it; the best come first.

    Semi-global matching with each neighbor guesses depths; PatchMatch with all neighbors chooses and improves.
    `load` returns the gray photo of a view.
    """
    image = load(view)
    # gray values are sampled at pixel centers
    centered = replace(view, sample_px=0.5)
    neighbors: list[tuple[View, GrayImage]] = []
    depths: list[DepthArray] = []
    reason = "no photo shares enough points"
    for neighbor in candidates:
        rectification = rectify(centered, neighbor)
        if isinstance(rectification, Rejected):
            reason = rectification.reason
            continue
        neighbors.append((neighbor, load(neighbor)))
        left, right = rectification.warp(image, neighbors[-1][1], (centered, neighbor))
        disparity = disparities(left, right, rectification.disparities)
        depths.append(depths_from_disparities(disparity, rectification, centered, neighbor))
        if len(depths) == count:
            break
    if not depths:
        return Rejected(reason)
    planes, cost = match_planes(np.stack(depths), centered, image, neighbors)
    mean = cv2.blur(image, (3, 3))
    cost[(mean <= OPTIONS.clipped_gray) | (mean >= 255 - OPTIONS.clipped_gray)] = NO_MATCH
    # at the view's position inside the pixel
    inverse = planes[..., 0] + np.float32(view.sample_px - 0.5) * (planes[..., 1] + planes[..., 2])
    known = (planes[..., 0] > 0) & (inverse > 0) & (cost < NO_MATCH)
    depth = np.divide(1, inverse, out=np.zeros_like(inverse), where=known)
    return DepthEstimate(depth, np.where(known, np.maximum(1 - cost, 0), np.float32(0)))


def count_maps(
    view: View, depth: DepthArray, others: Sequence[tuple[View, DepthArray]], tolerance: float
) -> NDArray[np.uint8]:
    """Count the other depth maps, (H, W), that confirm a depth (H, W) of a view, 0 where unknown, within a share."""
    count = np.zeros(depth.shape, np.uint8)
    for other, other_depth in others:
        _count(depth, other_depth, view.projection_into(other), tolerance, view.sample_px, count)
    return count


def filter_speckles(depth: DepthArray, tolerance: float) -> DepthArray:
    """Remove small patches in which depths differ by less than a relative tolerance from pixel to pixel."""
    known = depth > 0
    if not known.any():
        return depth
    logarithm = np.log(np.where(known, depth, depth[known].min()), dtype=np.float32)
    steps = 16  # integer levels per tolerance
    levels = 1 + (logarithm - logarithm.min()) * (steps / tolerance)
    # OpenCV needs 16 bits; depths beyond that range share one level
    patches = np.where(known, np.clip(levels, 1, 32000), -32000).astype(np.int16)
    cv2.filterSpeckles(patches, -32000, int(OPTIONS.min_patch * depth.size), steps)
    return np.where(patches > 0, depth, np.float32(0))


@kernel
def _count(
    depth: DepthArray,
    other_depth: DepthArray,
    P: FloatArray,
    tolerance: float,
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
            if (
                0 <= i < height
                and 0 <= j < width
                and (1.0 - tolerance) * w <= other_depth[i, j] <= (1.0 + tolerance) * w
            ):
                count[row, col] += 1


def confirm_depths(
    view: View,
    image: GrayImage,
    estimate: DepthEstimate,
    others: Sequence[tuple[View, DepthArray]],
    min_agreeing: int,
    tolerance: float,
) -> DepthMap | Rejected:
    """Keep depths that enough other maps confirm; remove specks, fill plain walls, add normals.

    The required number is `min_agreeing` >= 1; one more at low correlation; three more at very
    low correlation. There, a depth must also belong to a plain wall or lie between surer depths. Depths in skies are
    always dropped. Depths agree within a relative tolerance.
    """
    if not others:
        return Rejected("no other depth map to compare with")
    agreeing = count_maps(view, estimate.depth, others, tolerance)
    confidence = estimate.confidence
    least, more = (min(need, len(others)) for need in (min_agreeing, min_agreeing + 1))
    needed = np.where(confidence < OPTIONS.unsure_correlation, more, least)
    # without texture, semi-global matching extends depths beyond an object's outline, in all photos alike
    weak = confidence < OPTIONS.weak_correlation
    needed[weak] = min_agreeing + OPTIONS.weak_extra_maps
    sound = (estimate.depth > 0) & (agreeing >= needed)
    walls = plain_walls(weak, sound)
    sound &= ~weak | walls | enclosed_pixels(sound & ~weak)
    confirmed = np.where(sound & ~surfaceless_areas(confidence, sound), estimate.depth, np.float32(0))
    confirmed = filter_speckles(confirmed, tolerance)
    planes = fit_planes(fill_planar_areas(confirmed, image, tolerance, walls))
    if not planes.any():
        return Rejected("no depth is confirmed by other photos")
    depth = np.divide(1, planes[..., 0], out=np.zeros_like(confirmed), where=planes[..., 0] > 0)
    return DepthMap(depth, plane_normals(planes, view))
