"""Planes for plain areas: proposed from the depths around them, accepted where other photos propose the same.

Doors of cupboards and sheets of paper have depths only along their outlines. The area between may be their plane, or
an opening in front of a plain wall. Other photos show other outlines around the same place; their planes agree if there
is one (planar priors of several photos: Xu and Tao. Planar prior assisted PatchMatch multi-view stereo. AAAI 2020).
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from sfm_app.stereo.depth import count_maps
from sfm_app.stereo.patch_match import RADIUS_PX, fit_planes, plane_normals
from sfm_app.stereo.plain_areas import OPTIONS as AREA_OPTIONS
from sfm_app.stereo.plain_areas import consensus_plane, convex_hull, enclosed_pixels, uniform_areas
from sfm_app.stereo.view import DepthMap, GrayImage, View
from sfm_app.types.arrays import BoolArray, DepthArray, FloatArray


@dataclass(frozen=True, slots=True)
class ProposalOptions:
    """Which planes are proposed, and which proposals are accepted."""

    rim_px: int = 8
    """Width of the surroundings of an area; its blurred outline takes three of them. Chosen by hand."""
    most_planes: int = 4
    """Most planes around an area. Chosen by hand."""
    least_share: float = 0.1
    """Least share of the known depths in and around an area on a plane. Chosen by hand."""
    least_px: int = 100
    """Fewest pixels on a plane. Chosen by hand."""
    enough_px: int = 5000
    """Most pixels that a plane is fitted to. Chosen by hand."""
    least_agreeing: int = 3
    """Fewest other photos with the same depth. Chosen on kitchen1000: with two, 2 % fewer are right."""
    dark: float = 0.4
    """Gray level of an unlit opening, in medians of the surfaces of a photo; gates of castle-P19 have 0.1 to 0.3."""
    blur_px: float = 2.0
    """Standard deviation of the blur before this comparison, against noise."""
    deeper: float = 2.0
    """Tolerances beyond which a deeper point in another photo contradicts a proposal. Chosen by hand."""


OPTIONS = ProposalOptions()


def propose_planes(depth: DepthArray, image: GrayImage, tolerance: float) -> DepthArray:
    """Propose depths (H, W) for areas of uniform color without depths, from the planes around them.

    Only pixels enclosed by known pixels of a plane get a proposal, from the nearest plane. Dark areas get none: they
    may be openings. `tolerance` is the largest relative difference of depths that agree.
    """
    rim = OPTIONS.rim_px
    proposed = np.zeros_like(depth)
    labels, stats = uniform_areas(image)
    for label in range(1, len(stats)):
        left, top, width, height, area = stats[label]
        if area >= AREA_OPTIONS.min_area * image.size:
            rows = slice(max(top - rim, 0), top + height + rim)
            box = rows, slice(max(left - rim, 0), left + width + rim)
            _propose_within(depth[box], labels[box] == label, tolerance, proposed[box])
    # much darker than the known surfaces: gates and windows of unlit rooms
    median = np.median(image[depth > 0]) if (depth > 0).any() else 0.0
    proposed[cv2.GaussianBlur(image, (0, 0), OPTIONS.blur_px) < OPTIONS.dark * median] = 0
    return proposed


def _propose_within(depth: DepthArray, area: BoolArray, tolerance: float, proposed: DepthArray) -> None:
    unknown = area & (depth == 0)
    if not unknown.any():
        return
    side = 2 * OPTIONS.rim_px + 1
    surroundings = cv2.dilate(area.view(np.uint8), np.ones((side, side), np.uint8)) > 0
    nearest = np.full(depth.shape, np.inf, np.float32)
    for plane, members in _find_planes(depth, surroundings & (depth > 0), tolerance):
        distance = cv2.distanceTransform(1 - members.view(np.uint8), cv2.DIST_L2, 3)
        row, col = np.nonzero(unknown & (distance < nearest) & convex_hull(members) & enclosed_pixels(members))
        inverse = plane[0] + plane[1] * col + plane[2] * row
        row, col, inverse = (values[inverse > 0] for values in (row, col, inverse))
        proposed[row, col], nearest[row, col] = 1.0 / inverse, distance[row, col]


def _find_planes(depth: DepthArray, known: BoolArray, tolerance: float) -> Iterator[tuple[FloatArray, BoolArray]]:
    """Find planes one after the other: (3,) inverse depth over column and row, and (H, W) their pixels."""
    least, rest = max(OPTIONS.least_px, OPTIONS.least_share * np.count_nonzero(known)), known.copy()
    for _ in range(OPTIONS.most_planes):
        row, col = np.nonzero(rest)
        if len(row) < least:
            return
        A = np.asarray(np.column_stack([np.ones(len(row)), col, row]), np.float64)
        inverse = np.asarray(1.0 / depth[row, col], np.float64)
        sample = np.s_[:: -(-len(row) // OPTIONS.enough_px)]
        plane = consensus_plane(A[sample], inverse[sample], tolerance)
        on_plane = np.abs(A @ plane / inverse - 1.0) < tolerance
        if np.count_nonzero(on_plane) < least:
            return
        members = np.zeros(depth.shape, np.bool_)
        members[row[on_plane], col[on_plane]] = True
        rest &= ~members
        yield plane, members


def agreed_proposals(
    view: View,
    maps: tuple[DepthArray, DepthArray],
    others: Sequence[tuple[View, DepthArray, DepthArray]],
    tolerance: float,
) -> DepthArray:
    """Add to the depths of a photo the proposals (both in `maps`) that enough others share and none contradicts."""
    depth, proposed = maps
    known_or_proposed = [(other, np.where(known > 0, known, plane)) for other, known, plane in others]
    agreeing = count_maps(view, proposed, known_or_proposed, 1.0 - tolerance, 1.0 + tolerance)
    # a map that already contains proposals has the same meaning
    matched = [(other, np.where(plane > 0, np.float32(0), known)) for other, known, plane in others]
    contradicting = count_maps(view, proposed, matched, 1.0 + OPTIONS.deeper * tolerance)
    agreed = (proposed > 0) & (agreeing >= OPTIONS.least_agreeing) & (contradicting == 0)
    return np.where((depth == 0) & agreed, proposed, depth)


def add_depths(maps: DepthMap, depth: DepthArray, view: View) -> DepthMap:
    """Add the depths and normals of a depth map (H, W) to the maps of a photo where those have none."""
    new = ((maps.depth == 0) & (depth > 0)).view(np.uint8)
    side = 2 * RADIUS_PX + 1
    surroundings = cv2.dilate(new, np.ones((side, side), np.uint8)) > 0
    planes = fit_planes(np.where(surroundings, depth, np.float32(0)))
    added = (maps.depth == 0) & (planes[..., 0] > 0)
    normals = np.where(added[..., None], plane_normals(planes, view), maps.normals)
    return DepthMap(np.where(added, depth, maps.depth), normals)
