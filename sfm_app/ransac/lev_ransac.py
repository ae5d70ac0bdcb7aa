"""LEV-RANSAC as the program uses it: Algorithm 1 with what today's estimators have learnt since."""

from functools import partial

import numpy as np
from numpy.typing import NDArray

from sfm_app.ransac.leverage import mad_sigma, prior_validity
from sfm_app.ransac.loop import Recipe
from sfm_app.ransac.refit import fit_eight_point, refine_sampson
from sfm_app.ransac.scoring import msac, squared_distances
from sfm_app.ransac.verdict import estimate
from sfm_app.ransac.verification import BailOut
from sfm_app.settings import EpipolarSettings
from sfm_app.types import EpipolarFit, Rejected

FloatArray = NDArray[np.float64]

_WIDE = 2.0
_LOCAL_MATCHES, _LOCAL_STEPS = 1000, 5
_CAUCHY = 1.5
"""Scale of the last robust fit, in standard deviations of the inliers."""
_LEAST_SIGMA = 0.02
"""In thresholds: matches that are nearly perfect must not shut out all others."""


def optimise_locally(points: FloatArray, F: FloatArray, threshold: float) -> FloatArray:
    """8-point fit to the matches within twice the threshold, then a few robust Sampson steps; on a random thousand.

    A model through seven noisy matches misses many true ones by more than the threshold; from the wider set it reaches
    them (Chum, Matas and Kittler 2003).
    """
    some = points[:_LOCAL_MATCHES]
    near = squared_distances(some, np.ascontiguousarray(F).reshape(9)) <= (_WIDE * threshold) ** 2
    start = fit_eight_point(some, near.astype(np.float64)) if np.count_nonzero(near) >= 8 else F
    return refine_sampson(some, start, cutoff=_WIDE * threshold, scale=threshold / 2, most_steps=_LOCAL_STEPS)


def refit_to_all(points: FloatArray, F: FloatArray, threshold: float) -> FloatArray:
    """Robust fit to all matches: within twice the threshold, then within it at the scale of the inliers' own noise."""
    wide = refine_sampson(points, F, cutoff=_WIDE * threshold, scale=threshold / 3)
    distances = np.sqrt(squared_distances(points, np.ascontiguousarray(wide).reshape(9)))
    sigma = max(mad_sigma(distances[distances <= threshold]), _LEAST_SIGMA * threshold)
    return refine_sampson(points, wide, cutoff=threshold, scale=_CAUCHY * sigma)


PRODUCTION = Recipe(
    score=msac,
    validity=partial(prior_validity, sigma_from_inliers=True),
    guided_share=0.5,
    verifier=BailOut,
    patience=2000,
    oriented=True,
    improve=optimise_locally,
    finish=refit_to_all,
)


def fit_lev_ransac(x1: FloatArray, x2: FloatArray, options: EpipolarSettings, seed: int) -> EpipolarFit | Rejected:
    """The production estimator. See `estimate`."""
    return estimate(x1, x2, options, seed, PRODUCTION)
