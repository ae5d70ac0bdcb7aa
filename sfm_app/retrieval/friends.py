"""Pairs along the graph of matches: what two photos share with a third one, they probably share with each other.

The second round of matching. It closes loops: where one pair joins two places, their neighbors are asked, too.
"""

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from sfm_app.types import PairId

IndexArray = NDArray[np.int64]

BLOCK = 256
"""Photos whose keypoints are counted at once."""


def count_shared_keypoints(
    keypoints: Mapping[int, int], matches: Mapping[PairId, NDArray[np.uint32]]
) -> dict[PairId, int]:
    """Count, for pairs without matches, the keypoints of third photos that match in both.

    Args:
        keypoints: number of keypoints of each photo.
        matches: (N, 2) matching keypoints by pair.
    """
    photos = sorted(keypoints)
    place = {photo: k for k, photo in enumerate(photos)}
    partners: list[list[tuple[int, IndexArray]]] = [[] for _ in photos]
    for (a, b), rows in sorted(matches.items()):
        partners[place[a]].append((place[b], rows[:, 0].astype(np.int64)))
        partners[place[b]].append((place[a], rows[:, 1].astype(np.int64)))
    total = sparse.csr_array((len(photos), len(photos)), dtype=np.int64)
    for start in range(0, len(photos), BLOCK):
        part = range(start, min(start + BLOCK, len(photos)))
        seen = _points_in_others([partners[k] for k in part], [keypoints[photos[k]] for k in part], len(photos))
        total = sparse.csr_array(total + seen @ seen.T)
    found = sparse.triu(total, k=1).tocoo()
    named = ((photos[i], photos[j]) for i, j in zip(*(axis.tolist() for axis in found.coords), strict=True))
    return {pair: count for pair, count in zip(named, found.data.tolist(), strict=True) if pair not in matches}


def _points_in_others(
    partners: list[list[tuple[int, IndexArray]]], keypoints: list[int], photos: int
) -> sparse.csr_array:
    """Return (photos, keypoints of some photos) in which other photos each keypoint has a match."""
    starts = np.cumsum([0, *keypoints])
    ends = [(other, rows + starts[k]) for k, found in enumerate(partners) for other, rows in found]
    others = np.repeat(np.array([other for other, _ in ends], np.int64), [len(rows) for _, rows in ends])
    points = np.concatenate([np.zeros(0, np.int64), *(rows for _, rows in ends)])
    return sparse.coo_array((np.ones(len(points), np.int64), (others, points)), shape=(photos, starts[-1])).tocsr()
