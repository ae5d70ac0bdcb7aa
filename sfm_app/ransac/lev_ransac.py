"""LEV-RANSAC as the program uses it: Algorithm 1 with what today's estimators have learnt since."""

from functools import partial

import numpy as np
from numpy.typing import NDArray

from sfm_app.ransac.leverage import prior_validity
from sfm_app.ransac.loop import Recipe
from sfm_app.ransac.refit import refine_sampson
from sfm_app.ransac.scoring import MSAC
from sfm_app.ransac.verdict import estimate
from sfm_app.settings import EpipolarSettings
from sfm_app.types import EpipolarFit, Rejected

FloatArray = NDArray[np.float64]


def optimise_locally(points: FloatArray, F: FloatArray, threshold: float) -> FloatArray:
    """A few steps on a random thousand matches, within a widened threshold."""
    return refine_sampson(points[:1000], F, cutoff=1.5 * threshold, most_steps=6)


def refit_to_all(points: FloatArray, F: FloatArray, threshold: float) -> FloatArray:
    """Robust fit to all matches."""
    return refine_sampson(points, F, cutoff=2 * threshold, scale=threshold / 3)


PRODUCTION = Recipe(
    score=MSAC,
    validity=partial(prior_validity, sigma_from_inliers=True),
    guided_share=0.5,
    improve=optimise_locally,
    bail_out=True,
    finish=refit_to_all,
)


def fit_lev_ransac(x1: FloatArray, x2: FloatArray, options: EpipolarSettings, seed: int) -> EpipolarFit | Rejected:
    """The production estimator. See `estimate`."""
    return estimate(x1, x2, options, seed, PRODUCTION)
