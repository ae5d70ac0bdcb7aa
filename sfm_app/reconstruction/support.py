"""How well a model explains the matches: a score that does not ask how the model was made.

Every pair of photos with a place is asked how many of its raw matches lie on the epipolar lines of the model, before
both cameras. Points, tracks and reprojection errors differ with the mapper; this does not.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sfm_app.colmap.model import placed_views
from sfm_app.posegraph.pair_pose import in_front
from sfm_app.posegraph.refine import pose_distances
from sfm_app.types import MatchGraph, PairId, ViewGraph

FloatArray = NDArray[np.float64]

GENEROUS = 2.0
"""A match is explained within so many thresholds of an inlier: models are not adjusted to each pair."""
ENOUGH = 100.0
"""From so many matches on, more of them say little more about a pair."""


@dataclass(frozen=True, slots=True)
class Explained:
    """What a model makes of the matches of a pair."""

    matches: int
    """Raw matches that lie right."""
    inliers: int
    """Inliers of its fundamental matrix."""
    contradicted: int
    """Those of them that do not lie right."""


def explained_pairs(model: Any, matches: MatchGraph, views: ViewGraph, max_error_px: float) -> dict[PairId, Explained]:
    """What a model makes of every pair of its photos.

    Args:
        model: COLMAP's reconstruction.
        matches: keypoints and raw matches.
        views: fundamental matrices.
        max_error_px: largest Sampson distance of an inlier.
    """
    placed, found = placed_views(model, matches.keypoints), {}
    for pair in matches.matches:
        if pair[0] not in placed or pair[1] not in placed:
            continue
        first, second = placed[pair[0]], placed[pair[1]]
        R = second.R @ first.R.T
        t = second.t - R @ first.t
        rows = matches.matches[pair]
        rays = np.hstack([first.rays[rows[:, 0]], second.rays[rows[:, 1]]])
        focals = np.concatenate([first.focals, second.focals])
        right = pose_distances(rays, focals, R, t / max(float(np.linalg.norm(t)), 1e-300)) <= GENEROUS * max_error_px
        right &= in_front(rays, R, t)
        fit = views.fits.get(pair)
        wrong = int(np.count_nonzero(fit.inliers & ~right)) if fit else 0
        found[pair] = Explained(int(np.count_nonzero(right)), fit.inlier_count if fit else 0, wrong)
    return found


def support(explained: Mapping[PairId, Explained]) -> float:
    """One figure for a model: matches that it explains, pairs with many of them counting little more than others."""
    counts = np.array([pair.matches for pair in explained.values()], np.float64)
    return float(np.sum(counts / (1.0 + counts / ENOUGH)))
