"""Score how well a model explains the matches, independently of how the model was made.

For every pair of posed photos, the raw matches are counted that lie on the epipolar lines of the model, in front of
both cameras. Points, tracks and reprojection errors depend on the mapper; this count does not.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sfm_app.colmap.models.model import placed_views
from sfm_app.colmap.types import Reconstruction
from sfm_app.posegraph.pair_pose import is_in_front, ray_angles_deg
from sfm_app.posegraph.refine import pose_distances
from sfm_app.types import MatchGraph, PairId, RelativePose, ViewGraph

FloatArray = NDArray[np.float64]

LOOSE_FACTOR = 2.0
"""Largest error of an explained match, in inlier thresholds: models are not adjusted to each pair."""
SATURATION = 100.0
"""Number of matches at which the support of a pair reaches half of its limit; beyond it, more matches add little."""


@dataclass(frozen=True, slots=True)
class PairSupport:
    """Numbers of matches of a pair that a model explains or contradicts."""

    matches: int
    """Raw matches that the model explains."""
    inliers: int
    """Inliers of the fundamental matrix of the pair."""
    contradicted: int
    """Inliers that the model does not explain."""


def explained_pairs(
    model: Reconstruction, matches: MatchGraph, views: ViewGraph, max_error_px: float
) -> dict[PairId, PairSupport]:
    """Return how well a model explains every pair of its photos.

    Args:
        model: COLMAP's reconstruction.
        matches: keypoints and raw matches.
        views: fundamental matrices.
        max_error_px: largest Sampson distance of an inlier.
    """
    found = {}
    for pair, seen in _placed_pairs(model, matches):
        right = seen.inlier_mask(LOOSE_FACTOR * max_error_px)
        fit = views.fits.get(pair)
        wrong = int(np.count_nonzero(fit.inliers & ~right)) if fit else 0
        found[pair] = PairSupport(int(np.count_nonzero(right)), fit.inlier_count if fit else 0, wrong)
    return found


def model_poses(
    model: Reconstruction, matches: MatchGraph, max_error_px: float, least: int
) -> dict[PairId, RelativePose]:
    """Return the relative poses of a model for all pairs of its photos with enough explained matches.

    Args:
        model, matches, max_error_px: as in `explained_pairs`.
        least: smallest number of explained matches of a pair.
    """
    found = {}
    for pair, seen in _placed_pairs(model, matches):
        right = seen.inlier_mask(max_error_px)
        if np.count_nonzero(right) >= least:
            angle_deg = float(np.median(ray_angles_deg(seen.lines[right], seen.R)))
            found[pair] = RelativePose(seen.R, seen.t, right, angle_deg=angle_deg, in_front=1.0, kind="calibrated")
    return found


@dataclass(frozen=True, slots=True, eq=False)
class _PlacedPair:
    """The raw matches of two posed photos."""

    lines: FloatArray
    """(M, 18) matches as bearing vectors of view 1 and of view 2."""
    R: FloatArray
    t: FloatArray
    """Rotation and translation, view 2 from view 1; t has length 1, or is 0 for equal positions."""

    def inlier_mask(self, max_error_px: float) -> NDArray[np.bool_]:
        """Return (M,) which matches lie on their epipolar lines, in front of both cameras."""
        distances = pose_distances(self.lines, self.R, self.t)
        return np.asarray((distances <= max_error_px) & is_in_front(self.lines, self.R, self.t), bool)


def _placed_pairs(model: Reconstruction, matches: MatchGraph) -> Iterator[tuple[PairId, _PlacedPair]]:
    placed = placed_views(model, matches.keypoints)
    for pair, rows in matches.matches.items():
        if pair[0] not in placed or pair[1] not in placed:
            continue
        first, second = placed[pair[0]], placed[pair[1]]
        R = second.R @ first.R.T
        t = second.t - R @ first.t
        lines = np.hstack([first.lines[rows[:, 0]], second.lines[rows[:, 1]]])
        yield pair, _PlacedPair(lines, R, t / max(float(np.linalg.norm(t)), 1e-300))


def support(explained: Mapping[PairId, PairSupport]) -> float:
    """Return the score of a model: its explained matches, of which each further one of a pair counts less."""
    return float(np.sum(saturate([pair.matches for pair in explained.values()])))


def saturate(matches: Sequence[int]) -> FloatArray:
    """Return what the matches of pairs count in a score, (N,): each further match of a pair counts less.

    Args:
        matches: of each pair.
    """
    counts = np.array(matches, np.float64)
    return np.asarray(counts / (1.0 + counts / SATURATION))
