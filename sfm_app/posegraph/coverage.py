"""The share of their content that two photos have in common, and the backbone of pairs that have most of it.

Neighbors on a walk share most of what the rest of the set knows about either of them. Photos of equal things in
different places share only the things, however many matches these give, and nothing around them.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

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
    return Visibility(rows, seen, {photo: _keypoint_cells(matches, photo) for photo in photos})


def _keypoint_cells(matches: MatchGraph, photo: int) -> IndexArray:
    """Return the numbers (K,) of the cells in which the keypoints of a photo lie."""
    image = matches.images[photo]
    columns, lines = (matches.keypoints[photo] // (max(image.width, image.height) / CELLS)).astype(np.int64).T
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
    """Return the pairs of the maximum spanning tree of coverage, and those nearly as good as the path along it."""
    near: dict[int, list[tuple[int, float]]] = {photo: [] for pair in covered for photo in pair}
    group = {photo: photo for photo in near}
    for a, b in sorted(covered, key=lambda pair: (-covered[pair], pair)):
        if group[a] != group[b]:
            old, new = group[b], group[a]
            group = {photo: new if name == old else name for photo, name in group.items()}
            near[a].append((b, covered[a, b]))
            near[b].append((a, covered[a, b]))
    partners: dict[int, list[int]] = {}
    for a, b in covered:
        partners.setdefault(a, []).append(b)
    chosen = set()
    for a, others in partners.items():
        widest = _bottleneck_coverages(a, near)
        chosen |= {(a, b) for b in others if covered[a, b] >= BACKBONE_SHARE * widest[b]}
    return chosen


def _bottleneck_coverages(root: int, near: Mapping[int, list[tuple[int, float]]]) -> dict[int, float]:
    """Return, by photo, the weakest coverage on the path from the root along the tree."""
    found, waiting = {root: np.inf}, [root]
    while waiting:
        photo = waiting.pop()
        for other, value in near[photo]:
            if other not in found:
                found[other] = min(found[photo], value)
                waiting.append(other)
    return found
