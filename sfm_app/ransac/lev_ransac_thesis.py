"""LEV-RANSAC to the letter (thesis, Algorithm 1), and MSAC, which is the same without priors."""

from functools import partial

import numpy as np
from numpy.typing import NDArray

from sfm_app.ransac.leverage import prior_validity
from sfm_app.ransac.loop import Recipe
from sfm_app.ransac.refits import refit_sampson
from sfm_app.ransac.scoring import MSAC, MSAC_LINEAR
from sfm_app.ransac.verdict import estimate
from sfm_app.settings import EpipolarSettings
from sfm_app.types import EpipolarFit, Rejected

FloatArray = NDArray[np.float64]

THESIS = Recipe(
    score=MSAC_LINEAR,
    validity=partial(prior_validity, sigma_from_inliers=False),
    stop_on_convergence=True,
    finish=refit_sampson,
)
UNIFORM = Recipe(score=MSAC, finish=refit_sampson)


def fit_lev_ransac_thesis(
    x1: FloatArray, x2: FloatArray, options: EpipolarSettings, seed: int
) -> EpipolarFit | Rejected:
    """Algorithm 1: 7-point samples drawn by Cook's distances, linear MSAC penalty, stop when the priors have converged.

    The threshold is `max_error_px`; the thesis takes 1.96 px, for a noise of 1 px. See `estimate`.
    """
    return estimate(x1, x2, options, seed, THESIS)


def fit_msac(x1: FloatArray, x2: FloatArray, options: EpipolarSettings, seed: int) -> EpipolarFit | Rejected:
    """MSAC (Torr and Zisserman 2000): the same loop with uniform samples and the squared penalty. See `estimate`."""
    return estimate(x1, x2, options, seed, UNIFORM)
