"""LEV-RANSAC as the program uses it: Algorithm 1 with improvements from later estimators.

Thesis 4.7, with Chum, Matas and Kittler (2003), Chum, Werner and Matas (2004, 2005) and Capel (2005); the two scales,
the kinds of samples and the patience by evidence are ours.

One kind of cost is used throughout, r^2 / (r^2 + c^2), which has no threshold: with a coarse scale c for the models of
samples, which are noisy, and with a fine scale for models that were optimized on all matches nearby. Fine scales tell
the true geometry from one that lies on repeated structure or on a single plane.
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
from sfm_app.fundamental.degeneracy import OFF_PLANE, dominant_homography, recover_epipole, transfer_distance
from sfm_app.fundamental.estimate import estimate
from sfm_app.fundamental.leverage import prior_validity
from sfm_app.fundamental.loop import Recipe
from sfm_app.fundamental.pretests import BailOut
from sfm_app.fundamental.refits import fit_algebraic, refine_mixture, refine_sampson
from sfm_app.fundamental.scores import geman_mcclure, squared_distances
from sfm_app.settings import EpipolarSettings
from sfm_app.types import EpipolarFit, Rejected
from sfm_app.types.arrays import FloatArray

# How strongly the matches off the dominant plane support a model, and how long to wait for a better one.
#
# Ours, in place of thesis 4.7.4 (Eq. 4.18), which stops too early where the first models are poor.

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


COARSE, FINE = 0.25, 0.1
"""Scales c in thresholds. Chosen on the 156 raw pairs of the Strecha sets (docs/algorithms.md, Fundamental matrices);
`python -m benchmarks.fundamental --real DATA --ablation` has one score and other scores beside them."""
_ALGEBRAIC_REACH, _SAMPSON_REACH = 2.0, 4.0
"""Thresholds within which matches take part in the 8-point fit, and in the Sampson steps after it. docs/algorithms.md,
Fundamental matrices. Chosen on the Strecha sets together with the other constants of lev-ransac; not measured on their
own."""
_LOCAL_MATCHES, _LOCAL_STEPS, _COST_TOLERANCE = 1000, (5, 3), 1e-3
"""Most matches, steps at either scale, and relative decrease of the cost that ends them, in local optimization. The
1000 were chosen on the Strecha sets with six seeds; the others by hand, not measured on their own."""
_FINAL_REACH, _FINAL_STEPS = 3.0, 12
"""Thresholds within which matches take part in the final fit, and its largest number of steps (docs/algorithms.md,
Fundamental matrices). What the fit is worth: `python -m benchmarks.fundamental --real DATA --ablation`, least squares
instead; the numbers were chosen by hand."""


def _optimize_locally(points: FloatArray, F: FloatArray, threshold: float) -> FloatArray:
    """Fit by 8 points to the matches within twice the threshold, then step on the Sampson distance at both scales.

    A model through seven noisy matches misses many true ones by more than the threshold; a fit to the wider set reaches
    them (Chum, Matas and Kittler 2003).
    """
    squared = squared_distances(points, np.ascontiguousarray(F).reshape(9))
    around = np.flatnonzero(squared <= (_SAMPSON_REACH * threshold) ** 2)[:_LOCAL_MATCHES]
    some, wide = np.asfortranarray(points[around]), squared[around] <= (_ALGEBRAIC_REACH * threshold) ** 2
    F = fit_algebraic(some, wide.astype(np.float64)) if np.count_nonzero(wide) >= 8 else F
    for scale, steps in zip((COARSE, FINE), _LOCAL_STEPS, strict=True):
        F = refine_sampson(some, F, scale=scale * threshold, most_steps=steps, enough=_COST_TOLERANCE)
    return F


def _refit_by_likelihood(points: FloatArray, F: FloatArray, threshold: float) -> FloatArray:
    """Return the maximum likelihood F of all matches within three thresholds; their noise is estimated, too."""
    return refine_mixture(points, F, threshold=threshold, reach=_FINAL_REACH, most_steps=_FINAL_STEPS)


PRODUCTION = Recipe(
    score=partial(geman_mcclure, scale=COARSE),
    fine_score=partial(geman_mcclure, scale=FINE),
    validity=partial(prior_validity, sigma_from_inliers=True),
    guided_share=0.5,
    rest_share=0.25,
    batch=32,
    verifier=BailOut,
    least_trials=100,
    patience=search_patience,
    oriented=True,
    improve=_optimize_locally,
    recover=recover_epipole,
    finish=_refit_by_likelihood,
)
"""The shares, the batch and the patience were chosen on the Strecha sets and on synthetic pairs of thesis 4.8 and with
two motions. `python -m benchmarks.fundamental --real DATA --ablation` leaves out one part at a time; fresh
seeds and other sets stand in benchmarks/README.md."""


def fit_lev_ransac(x1: FloatArray, x2: FloatArray, options: EpipolarSettings, seed: int) -> EpipolarFit | Rejected:
    """Run the production estimator; see `estimate`.

    Args:
        x1: (N, 2) pixels in photo 1.
        x2: (N, 2) pixels in photo 2, row by row the partners of x1.
        options: threshold, confidence, largest number of samples, smallest number of inliers.
        seed: same seed, same result.
    """
    return estimate(x1, x2, options, seed, PRODUCTION)
