"""Plain areas between known surfaces: the planes of what is known around them, where other photos propose the same.

Doors of cupboards and sheets of paper show nothing but their outlines, and depths are known there alone. What lies
between them may be their plane, or an opening through which a plain wall is seen. Other photos tell: they see other
outlines around the same place, and the planes agree if it is one (planar priors of several photos: Xu and Tao. Planar
prior assisted PatchMatch multi-view stereo. AAAI 2020).
"""

from collections.abc import Iterator, Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from sfm_app.stereo.depth import DepthMap, count_confirming_maps, count_deeper_maps
from sfm_app.stereo.patch_match import RADIUS_PX, fit_planes, plane_normals
from sfm_app.stereo.plain_areas import MIN_AREA, consensus_plane, convex_hull, enclosed_pixels, uniform_areas
from sfm_app.stereo.view import DepthArray, GrayImage, View
from sfm_app.types.arrays import FloatArray

RIM_PX = 8
"""Width of the surroundings of an area; its blurred outline takes three of them. Chosen by hand."""
MOST_PLANES = 4
"""Planes around an area. Chosen by hand."""
LEAST_SHARE, LEAST_PX = 0.1, 100
"""Share of the known depths in and around an area that a plane holds, and fewest pixels. Chosen by hand."""
ENOUGH_PX = 5000
"""Most pixels that a plane is fitted to. Chosen by hand."""
LEAST_AGREEING = 3
"""Other photos with the same depth. Chosen on kitchen1000, where with two, two in a hundred fewer are right."""
DARK, BLUR_PX = 0.4, 2.0
"""Gray level, in medians of the surfaces of a photo, below which a plain area may be an opening without light, and the
blur against noise. Chosen on castle-P19, where gates have 0.1 to 0.3, and kitchen1000, where a tenth of what is right
has less."""
DEEPER = 2.0
"""Tolerances by which what another photo sees lies behind a proposal, so that it contradicts. Chosen by hand."""


def propose_planes(depth: DepthArray, image: GrayImage, tolerance: float) -> DepthArray:
    """Return depths (H, W) for areas of uniform color that have none, from the planes of what is known around them.

    Only pixels between known ones of the plane have a proposal; if there are several planes, that of the nearest ones.
    Dark areas have none: they may be openings.

    Args:
        depth: (H, W) depths that other photos confirm, 0 where unknown.
        image: (H, W) the photo.
        tolerance: largest relative difference of depths that agree.
    """
    proposed = np.zeros_like(depth)
    labels, stats = uniform_areas(image)
    for label in range(1, len(stats)):
        left, top, width, height, area = stats[label]
        if area >= MIN_AREA * image.size:
            rows = slice(max(top - RIM_PX, 0), top + height + RIM_PX)
            box = rows, slice(max(left - RIM_PX, 0), left + width + RIM_PX)
            _propose_within(depth[box], labels[box] == label, tolerance, proposed[box])
    proposed[_dark_pixels(image, depth > 0)] = 0
    return proposed


def _dark_pixels(image: GrayImage, known: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Mark pixels (H, W) that are much darker than most of what has a depth: gates and windows of unlit rooms."""
    usual = np.median(image[known]) if known.any() else 0.0
    return np.asarray(cv2.GaussianBlur(image, (0, 0), BLUR_PX) < DARK * usual)


def _propose_within(depth: DepthArray, area: NDArray[np.bool_], tolerance: float, proposed: DepthArray) -> None:
    """Write proposals for an area, in its bounding box."""
    unknown = area & (depth == 0)
    if not unknown.any():
        return
    around = cv2.dilate(area.view(np.uint8), np.ones((2 * RIM_PX + 1, 2 * RIM_PX + 1), np.uint8)) > 0
    nearest = np.full(depth.shape, np.inf, np.float32)
    for plane, members in _planes(depth, around & (depth > 0), tolerance):
        away = cv2.distanceTransform(1 - members.view(np.uint8), cv2.DIST_L2, 3)
        row, col = np.nonzero(unknown & (away < nearest) & convex_hull(members) & enclosed_pixels(members))
        inverse = plane[0] + plane[1] * col + plane[2] * row
        row, col, inverse = (values[inverse > 0] for values in (row, col, inverse))
        proposed[row, col], nearest[row, col] = 1.0 / inverse, away[row, col]


def _planes(
    depth: DepthArray, known: NDArray[np.bool_], tolerance: float
) -> Iterator[tuple[FloatArray, NDArray[np.bool_]]]:
    """Find planes one after the other: (3,) inverse depth over column and row, and (H, W) the pixels on it."""
    least, left = max(LEAST_PX, LEAST_SHARE * np.count_nonzero(known)), known.copy()
    for _ in range(MOST_PLANES):
        row, col = np.nonzero(left)
        if len(row) < least:
            return
        A = np.asarray(np.column_stack([np.ones(len(row)), col, row]), np.float64)
        inverse = np.asarray(1.0 / depth[row, col], np.float64)
        some = np.s_[:: -(-len(row) // ENOUGH_PX)]
        plane = consensus_plane(A[some], inverse[some], tolerance)
        on_plane = np.abs(A @ plane / inverse - 1.0) < tolerance
        if np.count_nonzero(on_plane) < least:
            return
        members = np.zeros(depth.shape, np.bool_)
        members[row[on_plane], col[on_plane]] = True
        left &= ~members
        yield plane, members


def agreed_proposals(
    view: View,
    maps: tuple[DepthArray, DepthArray],
    others: Sequence[tuple[View, DepthArray, DepthArray]],
    tolerance: float,
) -> DepthArray:
    """Return the depths of a photo with the proposals that enough other photos share, and that none sees through.

    Args:
        view: the photo.
        maps: (H, W) its depths and its proposals, 0 where there are none.
        others: other photos with theirs.
        tolerance: largest relative difference of depths that agree.
    """
    depth, proposed = maps
    all_known = [(other, np.where(known > 0, known, plane)) for other, known, plane in others]
    agreeing = count_confirming_maps(view, proposed, all_known, tolerance)
    # a map to which proposals were added already has the same meaning
    only_seen = [(other, np.where(plane > 0, np.float32(0), known)) for other, known, plane in others]
    contradicting = count_deeper_maps(view, proposed, only_seen, DEEPER * tolerance)
    agreed = (proposed > 0) & (agreeing >= LEAST_AGREEING) & (contradicting == 0)
    return np.where((depth == 0) & agreed, proposed, depth)


def add_depths(maps: DepthMap, depth: DepthArray, view: View) -> DepthMap:
    """Add depths to the maps of a photo where it has none.

    Args:
        maps: of the photo.
        depth: (H, W) the same depths and others.
        view: the photo.
    """
    new = ((maps.depth == 0) & (depth > 0)).view(np.uint8)
    side = 2 * RADIUS_PX + 1
    around = cv2.dilate(new, np.ones((side, side), np.uint8)) > 0
    planes = fit_planes(np.where(around, depth, np.float32(0)))
    added = (maps.depth == 0) & (planes[..., 0] > 0)
    normals = np.where(added[..., None], plane_normals(planes, view), maps.normals)
    return DepthMap(np.where(added, depth, maps.depth), normals)
