"""LEV-RANSAC as the program uses it: Algorithm 1 with improvements from later estimators.

Thesis 4.7, with Chum, Matas and Kittler (2003), Chum, Werner and Matas (2004, 2005) and Capel (2005); the two scales,
the kinds of samples and the patience by evidence are ours.

The cost is r^2 / (r^2 + c^2) throughout: with a coarse scale c for the noisy models of samples, with a fine one for
models optimized on all matches nearby. Fine scales distinguish the true geometry from repeated structure and planes.
"""

import math
from functools import partial

import numpy as np

from sfm_app.fundamental.a_contrario import (
    MOST_FALSE_ALARMS,
    accidental_share,
    model_false_alarms,
    squared_mismatch_distances,
)
from sfm_app.fundamental.degeneracy import DEGENERACY, dominant_homography, recover_epipole, transfer_distance
from sfm_app.fundamental.estimate import fit_by_recipe
from sfm_app.fundamental.leverage import prior_validity
from sfm_app.fundamental.loop import Recipe
from sfm_app.fundamental.pretests import BailOut
from sfm_app.fundamental.refits import fit_algebraic, refine_mixture, refine_sampson
from sfm_app.fundamental.scores import geman_mcclure, squared_distances
from sfm_app.settings import EpipolarSettings
from sfm_app.types import EpipolarFit, Rejected
from sfm_app.types.arrays import FloatArray


class OPTIONS:
    """Scales and limits, chosen together on the Strecha sets (docs/algorithms/lev-ransac.md).

    `python -m benchmarks.fundamental --real DATA --ablation` measures the parts they belong to.
    """

    coarse: float = 0.25
    """Scale c in thresholds for models of samples (docs/algorithms/lev-ransac.md)."""
    fine: float = 0.1
    """Scale c in thresholds for optimized models (docs/algorithms/lev-ransac.md)."""
    algebraic_reach: float = 2.0
    """Thresholds within which matches take part in the local 8-point fit (docs/algorithms/lev-ransac.md)."""
    sampson_reach: float = 4.0
    """Thresholds within which they take part in the local Sampson steps (docs/algorithms/lev-ransac.md)."""
    local_matches: int = 1000
    """Most matches in local optimization; on the Strecha sets with six seeds (benchmarks/README.md)."""
    local_steps: tuple[int, int] = (5, 3)
    """Steps of local optimization at the coarse and the fine scale. Chosen by hand."""
    local_tolerance: float = 1e-3
    """Relative decrease of the cost that ends them. Chosen by hand."""
    final_reach: float = 3.0
    """Thresholds within which matches take part in the final fit. Chosen by hand."""
    final_steps: int = 12
    """Most steps of the final fit. Chosen by hand."""
    evidence_scale: float = 1400.0
    """Samples to wait are the square of this over z; on the Strecha sets (docs/algorithms/lev-ransac.md)."""
    most_patience: float = 3000.0
    """Samples to wait where the evidence is poor, z below 26 (docs/algorithms/lev-ransac.md)."""
    least_patience: float = 250.0
    """Samples to wait where half of the matches are not explained; a quarter of them are drawn from the rest. Chosen on
    pairs with two motions: `python -m benchmarks.fundamental --two-motions 100`."""
    least_inliers: int = 8
    """Fewer are no evidence: a model always goes through seven. Chosen by hand."""


def search_patience(points: FloatArray, F: FloatArray, threshold: float) -> float:
    """Return how many samples without a better model are enough to accept this one; inf where support may be chance.

    Ours, in place of thesis 4.18, which stops too early where the first models are poor. Wrong models are supported by
    one plane, or by repeated structure, and by little else. Let z be the number of inliers off the dominant plane, in
    standard deviations above the number expected by chance: right models of real photos have z of 40 to 300, wrong ones
    mostly less than 40. Where most matches are not explained, they may belong to another motion, which takes time to
    sample.
    """
    f = np.ascontiguousarray(F).reshape(9)
    squared, wrong = squared_distances(points, f), squared_mismatch_distances(points, f)
    inliers = squared <= threshold * threshold
    if (
        np.count_nonzero(inliers) < OPTIONS.least_inliers
        or model_false_alarms(squared, wrong, threshold) > MOST_FALSE_ALARMS
    ):
        return math.inf
    H = dominant_homography(np.asfortranarray(points[inliers]), F, threshold)
    off_plane = transfer_distance(H, points) > DEGENERACY.off * threshold
    count, agreeing = np.count_nonzero(off_plane), np.count_nonzero(off_plane & inliers)
    chance = accidental_share(wrong, threshold)
    z = (agreeing - count * chance) / math.sqrt(count * chance * (1 - chance) + 1)
    least = OPTIONS.least_patience if 2 * np.count_nonzero(inliers) < len(points) else 0.0
    return max(min((OPTIONS.evidence_scale / max(z, 1.0)) ** 2, OPTIONS.most_patience), least)


def _optimize_locally(points: FloatArray, F: FloatArray, threshold: float) -> FloatArray:
    """Fit to the matches within twice the threshold, then refine at both scales (Chum, Matas and Kittler 2003)."""
    squared = squared_distances(points, np.ascontiguousarray(F).reshape(9))
    near = np.flatnonzero(squared <= (OPTIONS.sampson_reach * threshold) ** 2)[: OPTIONS.local_matches]
    nearby, wide = np.asfortranarray(points[near]), squared[near] <= (OPTIONS.algebraic_reach * threshold) ** 2
    F = fit_algebraic(nearby, wide.astype(np.float64)) if np.count_nonzero(wide) >= 8 else F
    for scale, steps in zip((OPTIONS.coarse, OPTIONS.fine), OPTIONS.local_steps, strict=True):
        F = refine_sampson(nearby, F, scale=scale * threshold, most_steps=steps, tolerance=OPTIONS.local_tolerance)
    return F


PRODUCTION = Recipe(
    score=partial(geman_mcclure, scale=OPTIONS.coarse),
    fine_score=partial(geman_mcclure, scale=OPTIONS.fine),
    validity=partial(prior_validity, sigma_from_inliers=True),
    guided_share=0.5,
    rest_share=0.25,
    batch=32,
    pretest=BailOut,
    least_trials=100,
    patience=search_patience,
    oriented=True,
    improve=_optimize_locally,
    recover=recover_epipole,
    finish=partial(refine_mixture, reach=OPTIONS.final_reach, most_steps=OPTIONS.final_steps),
)
"""Shares, batch and patience were chosen on the Strecha sets, on synthetic pairs of thesis 4.8 and on pairs with two
motions (benchmarks/README.md)."""


def fit_lev_ransac(x1: FloatArray, x2: FloatArray, options: EpipolarSettings, seed: int) -> EpipolarFit | Rejected:
    """Run the production estimator on x1, x2 (N, 2) pixels; see `fit_by_recipe`."""
    return fit_by_recipe(x1, x2, options, seed, PRODUCTION)
