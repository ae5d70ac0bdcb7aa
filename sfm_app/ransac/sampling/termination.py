"""How strongly the matches off the dominant plane support a model, and how long to wait for a better one.

Ours, in place of thesis 4.7.4 (Eq. 4.18), which stops too early where the first models are poor.
"""

import math

import numpy as np
from numpy.typing import NDArray

from sfm_app.ransac.degeneracy.dominant_plane import OFF_PLANE, dominant_homography, transfer_distance
from sfm_app.ransac.scoring.robust_costs import squared_distances
from sfm_app.ransac.verification.a_contrario import (
    MOST_FALSE_ALARMS,
    accidental_share,
    model_false_alarms,
    squared_mismatch_distances,
)

FloatArray = NDArray[np.float64]

_EVIDENCE_SCALE = 1400.0
"""Samples to wait are the square of this over z (docs/algorithms.md, Fundamental matrices). Chosen on the Strecha sets;
`python -m benchmarks.fundamental --real DATA --ablation` compares with a search without it."""
_MOST_PATIENCE = 3000.0
"""Samples to wait where the evidence is poor, z below 26. Chosen with the constant above (docs/algorithms.md,
Fundamental matrices)."""
_LEAST_PATIENCE = 250.0
"""A quarter of these samples are drawn from the rest; a motion that holds two thirds of it fills one in 17 of them.
Chosen on pairs with two motions: `python -m benchmarks.fundamental --two-motions 100`."""
_LEAST_INLIERS = 8
"""Fewer are no evidence: a model always goes through seven, and one more is asked for. Chosen by hand; not measured on
its own."""


def search_patience(points: FloatArray, F: FloatArray, threshold: float) -> float:
    """Return how many samples without a better model are enough to accept this one.

    Wrong models are supported by one plane, or by repeated structure, and by little else. Let z be the number of
    inliers off the dominant plane, in standard deviations above the number expected by chance: right models of real
    photos have z of 40 to 300, wrong ones mostly less than 40. The patience is 3000 samples up to z = 26 and falls as
    1 / z^2. Where most matches are not explained, they may belong to another motion, which needs time to be sampled.

    Args:
        points: (N, 4) distinct matches in random order, N >= 7.
        F: (3, 3).
        threshold: largest distance of an inlier.

    Returns:
        The number; inf where even the whole support may be chance.
    """
    squared = squared_distances(points, np.ascontiguousarray(F).reshape(9))
    inliers, wrong = (
        squared <= threshold * threshold,
        squared_mismatch_distances(points, np.ascontiguousarray(F).reshape(9)),
    )
    if np.count_nonzero(inliers) < _LEAST_INLIERS or model_false_alarms(squared, wrong, threshold) > MOST_FALSE_ALARMS:
        return math.inf
    H = dominant_homography(np.asfortranarray(points[inliers]), F, threshold)
    off_plane = transfer_distance(H, points) > OFF_PLANE * threshold
    count, agreeing = np.count_nonzero(off_plane), np.count_nonzero(off_plane & inliers)
    chance = accidental_share(wrong, threshold)
    z = (agreeing - count * chance) / math.sqrt(count * chance * (1 - chance) + 1)
    least = _LEAST_PATIENCE if 2 * np.count_nonzero(inliers) < len(points) else 0.0
    return max(min((_EVIDENCE_SCALE / max(z, 1.0)) ** 2, _MOST_PATIENCE), least)
