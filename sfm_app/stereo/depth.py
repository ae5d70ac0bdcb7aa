"""Depth maps of a photo: matched with its neighbours, then checked against their depth maps."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sfm_app.stereo.consistency import count_agreeing, merge_hypotheses
from sfm_app.stereo.matching import depths_from_disparities, disparities, has_texture
from sfm_app.stereo.normals import fit_planes
from sfm_app.stereo.rectify import rectify
from sfm_app.stereo.view import DepthArray, GreyImage, View
from sfm_app.types import Rejected


@dataclass(frozen=True, slots=True, eq=False)
class DepthMap:
    """Depths of one photo."""

    depth: DepthArray
    normals: NDArray[np.float32]
    """(H, W, 3) unit, camera frame, towards the camera; 0 where the depth is 0."""

    @property
    def coverage(self) -> float:
        """Share of the pixels that have a depth."""
        return float(np.count_nonzero(self.depth) / self.depth.size)


def match_depths(
    view: View, candidates: Sequence[View], load: Callable[[View], GreyImage], count: int, tolerance: float
) -> DepthArray | Rejected:
    """Match a photo with the first `count` candidates that can be rectified with it, and merge what they say.

    Returns:
        (H, W) depth before any check against other depth maps, or why there is none.
    """
    image = load(view)
    found: list[tuple[DepthArray, DepthArray]] = []
    reason = "no photo shares enough points"
    for neighbour in candidates:
        rectification = rectify(view, neighbour)
        if isinstance(rectification, Rejected):
            reason = rectification.reason
            continue
        left, right = rectification.warp(image, load(neighbour), (view, neighbour))
        disparity = disparities(left, right, rectification.disparities)
        found.append(depths_from_disparities(disparity, rectification, view, neighbour))
        if len(found) == count:
            break
    if not found:
        return Rejected(reason)
    depth, _ = merge_hypotheses(np.stack([d for d, _ in found]), np.stack([p for _, p in found]), tolerance)
    return np.where(has_texture(image), depth, np.float32(0))


def confirm_depths(
    view: View, depth: DepthArray, others: Sequence[tuple[View, DepthArray]], min_agreeing: int, tolerance: float
) -> DepthMap | Rejected:
    """Keep the depths that enough other depth maps confirm, and add normals."""
    enough = min(min_agreeing, len(others))
    if enough == 0:
        return Rejected("no other depth map to compare with")
    confirmed = np.where(count_agreeing(view, depth, others, tolerance) >= enough, depth, np.float32(0))
    normals, planes = fit_planes(view, confirmed)
    if not planes.any():
        return Rejected("no depth is confirmed by other photos")
    return DepthMap(planes, normals)
