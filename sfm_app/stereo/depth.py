"""The depth map of a photo: matched with neighboring photos, then checked against their depth maps."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from sfm_app.stereo.consistency import count_confirming_maps, filter_speckles, merge_hypotheses
from sfm_app.stereo.edge_fattening import remove_spill, rim_mask
from sfm_app.stereo.matching import depths_from_disparities, disparities
from sfm_app.stereo.normals import fit_planes, plane_normals
from sfm_app.stereo.patch_match import NO_MATCH, PlaneArray, improve_planes
from sfm_app.stereo.plain.enclosure import enclosed_pixels
from sfm_app.stereo.plain.planar_fill import fill_planar_areas
from sfm_app.stereo.plain.textureless import plain_walls, surfaceless_areas
from sfm_app.stereo.rectify import rectify
from sfm_app.stereo.view import DepthArray, GrayImage, View
from sfm_app.types import Rejected

SWEEPS = 1
"""The second improves a hundredth of the pixels and takes as long as the first."""
WEAK_CORRELATION = 0.3
"""Correlation below which there is hardly any texture: in skies depths agree only by chance, and on plain walls
semi-global matching interpolates between the windows in the same way in every photo."""
WEAK_EXTRA_MAPS = 3
"""Additional depth maps that have to agree at such a correlation; with too few maps, the depth is dropped."""
UNSURE_CORRELATION = 0.5
"""Correlation below which one more depth map has to agree."""

CLIPPED_GRAY = 4
"""Gray levels from black or white within which pixels are clipped: their depths come from neighboring pixels."""


@dataclass(frozen=True, slots=True, eq=False)
class DepthMap:
    """Depths of one photo."""

    depth: DepthArray
    normals: NDArray[np.float32]
    """(H, W, 3) unit, camera frame, towards the camera; 0 where the depth is 0."""

    @classmethod
    def unknown(cls, view: View) -> "DepthMap":
        """Return a map of a photo without any depth."""
        return cls(np.zeros((view.height, view.width), np.float32), np.zeros((view.height, view.width, 3), np.float32))


@dataclass(frozen=True, slots=True, eq=False)
class DepthEstimate:
    """Depths of one photo before the check against other depth maps."""

    depth: DepthArray
    confidence: NDArray[np.float32]
    """(H, W) in [0, 1]: mean correlation with the better half of the neighbors; 0 where the depth is 0."""


def match_depths(
    view: View, candidates: Sequence[View], load: Callable[[View], GrayImage], count: int, tolerance: float
) -> DepthEstimate | Rejected:
    """Match a photo with the first candidates that can be rectified with it, and combine the results.

    Semi-global matching with each neighbor gives depths; the merged depths initialize PatchMatch with all neighbors.

    Args:
        view: the photo.
        candidates: possible neighbors, best first.
        load: returns the gray photo of a view.
        count: neighbors at most.
        tolerance: relative difference within which depths agree.
    """
    image = load(view)
    # gray values are sampled at pixel centers
    centered = replace(view, sample_px=0.5)
    used: list[tuple[View, GrayImage]] = []
    found: list[tuple[DepthArray, DepthArray]] = []
    reason = "no photo shares enough points"
    for neighbor in candidates:
        rectification = rectify(centered, neighbor)
        if isinstance(rectification, Rejected):
            reason = rectification.reason
            continue
        used.append((neighbor, load(neighbor)))
        left, right = rectification.warp(image, used[-1][1], (centered, neighbor))
        disparity = disparities(left, right, rectification.disparities)
        found.append(depths_from_disparities(disparity, rectification, centered, neighbor))
        if len(found) == count:
            break
    if not found:
        return Rejected(reason)
    depth, _ = merge_hypotheses(np.stack([d for d, _ in found]), np.stack([p for _, p in found]), tolerance)
    planes = _initial_planes(depth)
    cost = improve_planes(planes, centered, image, used, SWEEPS)
    cost[clipped_mask(image)] = NO_MATCH
    return _sample_planes(planes, cost, view.sample_px)


def clipped_mask(image: GrayImage) -> NDArray[np.bool_]:
    """Return (H, W) whether the 3x3 mean around a pixel is nearly black or white."""
    around = cv2.blur(image, (3, 3))
    return np.asarray((around <= CLIPPED_GRAY) | (around >= 255 - CLIPPED_GRAY))


def _initial_planes(depth: DepthArray) -> PlaneArray:
    """Return planes with the exact depth of each pixel and the slopes fitted to its surroundings."""
    planes = fit_planes(depth)
    planes[..., 0] = np.divide(1, depth, out=np.zeros_like(depth), where=depth > 0)
    return planes


def _sample_planes(planes: PlaneArray, cost: NDArray[np.float32], sample_px: float) -> DepthEstimate:
    """Sample depths and confidences at the position inside the pixel that a view asks for."""
    shift = np.float32(sample_px - 0.5)
    inverse = planes[..., 0] + shift * (planes[..., 1] + planes[..., 2])
    known = (planes[..., 0] > 0) & (inverse > 0) & (cost < NO_MATCH)
    depth = np.divide(1, inverse, out=np.zeros_like(inverse), where=known)
    return DepthEstimate(depth, np.where(known, np.maximum(1 - cost, 0), np.float32(0)))


def confirm_depths(
    view: View,
    image: GrayImage,
    estimate: DepthEstimate,
    others: Sequence[tuple[View, DepthArray]],
    min_agreeing: int,
    tolerance: float,
) -> DepthMap | Rejected:
    """Keep depths that enough other maps confirm; remove spill and specks, fill plain walls, add normals.

    The required number is `min_agreeing`; one more at low correlation and next to broad gaps; three more at very low
    correlation. There, a depth must belong to a plain wall or lie between surer ones, too. Depths in skies are always
    dropped.

    Args:
        view: the photo.
        image: (H, W) gray photo.
        estimate: from `match_depths`.
        others: other photos with their depth maps.
        min_agreeing: maps, >= 1.
        tolerance: relative difference within which depths agree.
    """
    if not others:
        return Rejected("no other depth map to compare with")
    agreeing = count_confirming_maps(view, estimate.depth, others, tolerance)
    confidence = estimate.confidence
    least, more = (min(need, len(others)) for need in (min_agreeing, min_agreeing + 1))
    enough = np.where(confidence < UNSURE_CORRELATION, more, least)
    enough[confidence < WEAK_CORRELATION] = min_agreeing + WEAK_EXTRA_MAPS
    sound = (estimate.depth > 0) & (agreeing >= enough)
    # without texture, semi-global matching carries depths on beyond the outline of a thing, in all photos alike
    weak = confidence < WEAK_CORRELATION
    walls = plain_walls(weak, sound)
    sound &= ~weak | walls | enclosed_pixels(sound & ~weak)
    confirmed = np.where(sound & ~surfaceless_areas(confidence, sound), estimate.depth, np.float32(0))
    doubtful = rim_mask(confirmed > 0) & (agreeing < more)
    confirmed = filter_speckles(remove_spill(np.where(doubtful, np.float32(0), confirmed), image), tolerance)
    planes = fit_planes(fill_planar_areas(confirmed, image, tolerance, walls))
    if not planes.any():
        return Rejected("no depth is confirmed by other photos")
    depth = np.divide(1, planes[..., 0], out=np.zeros_like(confirmed), where=planes[..., 0] > 0)
    return DepthMap(depth, plane_normals(planes, view))
