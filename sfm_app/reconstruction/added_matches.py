"""Merge matches of two kinds of features of the same photos."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from sfm_app.types import MatchGraph, PairId

FloatArray = NDArray[np.float64]
Rows = NDArray[np.uint32]

SAME_PX = 0.5
"""Keypoints nearer than this count as one, so that tracks continue across kinds; about the noise of SIFT."""


def add_matches(
    matches: MatchGraph, keypoints: Mapping[int, FloatArray], added: Mapping[PairId, Rows]
) -> tuple[MatchGraph, tuple[PairId, ...]]:
    """Add keypoints and matches of another kind.

    Existing keypoints keep their positions and indices. An added match enters only if neither of its keypoints has a
    match in the other photo yet.

    Args:
        matches: existing keypoints and matches.
        keypoints: (N, 2) pixels of the added keypoints, by photo.
        added: (M, 2) indices of added keypoints, by pair.

    Returns:
        The merged match graph, and the pairs that have gained matches.
    """
    every, numbers = dict(matches.keypoints), {}
    for photo, found in keypoints.items():
        every[photo], numbers[photo] = _merge_keypoints(matches.keypoints[photo], found)
    rows, changed = dict(matches.matches), []
    for pair, new in added.items():
        known = rows.get(pair, np.zeros((0, 2), np.uint32))
        renamed = np.column_stack([numbers[photo][new[:, side]] for side, photo in enumerate(pair)])
        together = _drop_repeats(np.vstack([known, renamed.astype(np.uint32)]))
        if len(together) > len(known):
            rows[pair] = together
            changed.append(pair)
    return replace(matches, keypoints=every, matches=dict(sorted(rows.items()))), tuple(sorted(changed))


def _merge_keypoints(known: FloatArray, found: FloatArray) -> tuple[FloatArray, NDArray[np.int64]]:
    """Return all keypoints of a photo, and the index of each added one among them."""
    numbers = len(known) + np.arange(len(found))
    if len(known) and len(found):
        away, nearest = cKDTree(known).query(found)
        numbers = np.where(away <= SAME_PX, nearest, numbers)
    return np.vstack([known.reshape(-1, 2), found]), numbers.astype(np.int64)


def _drop_repeats(rows: Rows) -> Rows:
    """Return the rows whose keypoints, in either photo, occur in no earlier row."""
    first = [np.isin(np.arange(len(rows)), np.unique(rows[:, side], return_index=True)[1]) for side in (0, 1)]
    return rows[first[0] & first[1]]
