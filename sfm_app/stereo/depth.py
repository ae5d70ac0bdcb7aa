"""Depth maps of a photo: matched with its neighbors, then checked against their depth maps."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from sfm_app.stereo.consistency import count_agreeing, merge_hypotheses, without_specks
from sfm_app.stereo.edge_fattening import rims, without_spill
from sfm_app.stereo.matching import depths_from_disparities, disparities
from sfm_app.stereo.normals import fit_planes, normals_of
from sfm_app.stereo.patch_match import NO_MATCH, PlaneArray, improve_planes
from sfm_app.stereo.planar_fill import bridge_even_areas
from sfm_app.stereo.rectify import rectify
from sfm_app.stereo.textureless import without_surface
from sfm_app.stereo.view import DepthArray, GrayImage, View
from sfm_app.types import Rejected

SWEEPS = 1
"""The second improves a hundredth of the pixels and takes as long as the first."""
WEAK = 0.3
"""Correlation below which there is next to nothing to be seen: in skies depths agree by chance at most, on plain walls
semi-global matching bridges what is between the windows in every photo alike."""
WEAK_NEED = 3
"""That many more depth maps have to agree there; where there are not so many, it stays empty."""
UNSURE = 0.5
"""Correlation below which one more depth map has to agree."""

CLIPPED_GRAY = 4
"""Within so many levels of black or of white nothing is seen, and what matching finds there comes from beside it."""


@dataclass(frozen=True, slots=True, eq=False)
class DepthMap:
    """Depths of one photo."""

    depth: DepthArray
    normals: NDArray[np.float32]
    """(H, W, 3) unit, camera frame, towards the camera; 0 where the depth is 0."""


@dataclass(frozen=True, slots=True, eq=False)
class DepthEstimate:
    """Depths of one photo before other depth maps were asked."""

    depth: DepthArray
    confidence: NDArray[np.float32]
    """(H, W) in [0, 1]: how well the better half of the neighbors look alike there; 0 where the depth is 0."""


def match_depths(
    view: View, candidates: Sequence[View], load: Callable[[View], GrayImage], count: int, tolerance: float
) -> DepthEstimate | Rejected:
    """Match a photo with the first candidates that can be rectified with it, and find what suits them all.

    Semi-global matching with each neighbor gives depths; where they agree they start PatchMatch with all neighbors.

    Args:
        view: the photo.
        candidates: possible neighbors, best first.
        load: gives the gray photo of a view.
        count: neighbors at most.
        tolerance: relative difference within which depths agree.
    """
    image = load(view)
    # images have their values at the pixels' centers
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
    planes = _started(depth)
    cost = improve_planes(planes, centered, image, used, SWEEPS)
    cost[clipped(image)] = NO_MATCH
    return _sampled(planes, cost, view.sample_px)


def clipped(image: GrayImage) -> NDArray[np.bool_]:
    """Return (H, W) whether a photo is black or blown out at a pixel and around it."""
    around = cv2.blur(image, (3, 3))
    return np.asarray((around <= CLIPPED_GRAY) | (around >= 255 - CLIPPED_GRAY))


def _started(depth: DepthArray) -> PlaneArray:
    """Return planes at the depths themselves, with the slopes of what is around them."""
    planes = fit_planes(depth)
    planes[..., 0] = np.divide(1, depth, out=np.zeros_like(depth), where=depth > 0)
    return planes


def _sampled(planes: PlaneArray, cost: NDArray[np.float32], sample_px: float) -> DepthEstimate:
    """Return depths and confidences where a view wants them in its pixels."""
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
    """Keep the depths that enough other maps confirm, cut at outlines; drop specks, bridge plain walls, add normals.

    Enough is `min_agreeing`; one more where the photos look little alike and beside broad empty places, three more
    where they hardly do, and never in skies.

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
    agreeing = count_agreeing(view, estimate.depth, others, tolerance)
    confidence = estimate.confidence
    least, more = (min(need, len(others)) for need in (min_agreeing, min_agreeing + 1))
    enough = np.where(confidence < UNSURE, more, least)
    enough[confidence < WEAK] = min_agreeing + WEAK_NEED
    sound = (estimate.depth > 0) & (agreeing >= enough)
    confirmed = np.where(sound & ~without_surface(confidence, sound), estimate.depth, np.float32(0))
    doubtful = rims(confirmed > 0) & (agreeing < more)
    confirmed = without_specks(without_spill(np.where(doubtful, np.float32(0), confirmed), image), tolerance)
    planes = fit_planes(bridge_even_areas(confirmed, image, tolerance))
    if not planes.any():
        return Rejected("no depth is confirmed by other photos")
    depth = np.divide(1, planes[..., 0], out=np.zeros_like(confirmed), where=planes[..., 0] > 0)
    return DepthMap(depth, normals_of(planes, view))
