"""The share of their content that two photos have in common, and the backbone of pairs that have most of it.

Neighbors on a walk share most of what the rest of the set knows about either of them. Photos of equal things in
different places share only the things, however many matches these give, and nothing around them.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sfm_app.posegraph.groups import DisjointGroups
from sfm_app.types import MatchGraph, PairId, RelativePose

IndexArray = NDArray[np.int64]

CELLS = 12
"""Cells along the longer side of a photo. 16 give the same on oats23 and books21; with 24 one wrong pair enters the
backbone of oats23, and nothing is found there. docs/algorithms.md, Look-alikes."""
MIN_OTHER_PHOTOS = 2
"""A keypoint is known to the set if it has partners in this many photos besides that of the pair. Chosen by hand;
halved and doubled by `benchmarks.sensitivity`."""
BACKBONE_SHARE = 0.9
"""A pair belongs to the backbone if its coverage is at least this share of that of the weakest pair on the best path
between its photos. On oats23 and books21 equal things in different places reach 0.84 at most. docs/algorithms.md,
Look-alikes."""


@dataclass(frozen=True, slots=True, eq=False)
class Visibility:
    """Inliers of all pairs, and the keypoints and cells of the photos that they are in."""

    rows: Mapping[PairId, IndexArray]
    """By pair, (N, 2) keypoints of its inliers in photo 1 and photo 2."""
    seen: Mapping[int, IndexArray]
    """By photo, (K,) number of other photos in which each keypoint has a partner."""
    cells: Mapping[int, IndexArray]
    """By photo, (K,) number of the cell of each keypoint."""


def compute_visibility(matches: MatchGraph, poses: Mapping[PairId, RelativePose]) -> Visibility:
    """Collect the inliers of all pairs, their counts by keypoint, and the cells of all keypoints.

    Args:
        matches: keypoints and raw matches.
        poses: relative poses by pair, with their inliers.
    """
    rows = {pair: matches.matches[pair][pose.inliers].astype(np.int64) for pair, pose in poses.items()}
    photos = sorted({photo for pair in poses for photo in pair})
    seen = {photo: np.zeros(len(matches.keypoints[photo]), np.int64) for photo in photos}
    for pair, found in rows.items():
        for photo, column in zip(pair, found.T, strict=True):
            seen[photo][np.unique(column)] += 1
    images = matches.images
    cells = {
        photo: cell_numbers(matches.keypoints[photo], images[photo].width, images[photo].height) for photo in photos
    }
    return Visibility(rows, seen, cells)


def cell_numbers(x: NDArray[np.float64], width: int, height: int) -> IndexArray:
    """Return the numbers (N,) of the cells of a photo in which pixels lie, less than (`CELLS` + 1) squared.

    Args:
        x: (N, 2) pixels inside the photo.
        width, height: of the photo.
    """
    columns, lines = (x // (max(width, height) / CELLS)).astype(np.int64).T
    return np.asarray(lines * (CELLS + 1) + columns, np.int64)


def coverages(sight: Visibility) -> dict[PairId, float]:
    """Return by pair the share of the known cells that it covers, mean over its two photos, 0 to 1."""
    found = {}
    for pair, rows in sight.rows.items():
        shares = []
        for photo, column in zip(pair, rows.T, strict=True):
            seen, cells = sight.seen[photo], sight.cells[photo]
            hit = np.zeros(len(seen), np.bool_)
            hit[column] = True
            covered = np.unique(cells[hit])
            known = np.unique(cells[hit | (seen >= MIN_OTHER_PHOTOS)])
            shares.append(len(covered) / len(known))
        found[pair] = float(np.mean(shares))
    return found


def backbone(covered: Mapping[PairId, float]) -> set[PairId]:
    """Return the pairs of the maximum spanning tree of coverage, and those nearly as good as the path along it.

    Groups of photos grow along the best pairs. When two of them join, the pair that joins them is the weakest one on
    the path between any photo of the one and any of the other.
    """
    partners: dict[int, list[int]] = {photo: [] for pair in covered for photo in pair}
    for a, b in covered:
        partners[a].append(b)
        partners[b].append(a)
    groups, chosen = DisjointGroups(partners), set()
    for a, b in sorted(covered, key=lambda pair: (-covered[pair], pair)):
        moved = groups.join(a, b)
        inside = set(moved)
        for photo in moved:
            across = (
                other for other in partners[photo] if other not in inside and groups.name[other] == groups.name[a]
            )
            joined = ((min(photo, other), max(photo, other)) for other in across)
            chosen |= {pair for pair in joined if covered[pair] >= BACKBONE_SHARE * covered[a, b]}
    return chosen
