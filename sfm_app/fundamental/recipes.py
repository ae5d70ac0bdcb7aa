"""The estimators of thesis chapter 4, each described by the parts that differ from the defaults of `loop.Recipe`.

The recipe of the program's own estimator is not in this table: it is `lev_ransac.PRODUCTION`.
The threshold T is `max_error_px`; the thesis takes 1.96 px for a noise of 1 px.
"""

import math
from collections.abc import Mapping
from dataclasses import replace
from functools import partial

import numpy as np

from sfm_app.fundamental.leverage import prior_validity
from sfm_app.fundamental.loop import Recipe
from sfm_app.fundamental.pretests import RandomizedTdd, Sprt
from sfm_app.fundamental.refits import refit_sampson
from sfm_app.fundamental.scores import lmeds, mlesac, msac, msac_linear, ransac, residual_validity, squared_distances
from sfm_app.numerical import MAD_TO_SIGMA
from sfm_app.types.arrays import FloatArray


def _refit_to_median(points: FloatArray, F: FloatArray, _threshold: float) -> FloatArray:
    """Refit to the matches within 2.5 robust standard deviations (Rousseeuw and Leroy 1987)."""
    squared = squared_distances(points, np.ascontiguousarray(F).reshape(9))
    return refit_sampson(points, F, 2.5 * median_sigma(squared))


def median_sigma(squared: FloatArray) -> float:
    """Return sigma of the inliers from the median, with 1 + 5 / (n - 7) (Rousseeuw and Leroy 1987)."""
    return MAD_TO_SIGMA * (1 + 5 / max(len(squared) - 7, 1)) * math.sqrt(float(np.median(squared)))


RANSAC = Recipe(score=ransac, finish=refit_sampson)
LEV_RANSAC = replace(
    RANSAC, score=msac_linear, validity=partial(prior_validity, sigma_from_inliers=False), stop_on_convergence=True
)

RECIPES: Mapping[str, tuple[Recipe, str]] = {
    "lev-ransac-thesis": (LEV_RANSAC, "Algorithm 1 of the thesis to the letter"),
    "lev-ransac-sprt": (
        replace(LEV_RANSAC, pretest=Sprt),
        "lev-ransac-thesis with Wald's sequential test of hypotheses",
    ),
    "lev-ransac-tdd": (
        replace(LEV_RANSAC, pretest=RandomizedTdd),
        "lev-ransac-thesis with the T(1,1) test of hypotheses",
    ),
    "res-ransac": (
        replace(RANSAC, score=mlesac, validity=residual_validity, warmup_share=0.1),
        "MLESAC with samples guided by the residuals of the best model",
    ),
    "mlesac": (replace(RANSAC, score=mlesac), "likelihood of Gaussian inliers and uniform outliers"),
    "msac": (replace(RANSAC, score=msac), "uniform samples, truncated squared error"),
    "ransac": (RANSAC, "uniform samples, number of outliers"),
    "ransac-sprt": (replace(RANSAC, pretest=Sprt), "ransac with Wald's sequential test of hypotheses"),
    "ransac-tdd": (replace(RANSAC, pretest=RandomizedTdd), "ransac with the T(1,1) test of hypotheses"),
    "lmeds": (
        replace(RANSAC, score=lmeds, assumed_share=0.5, finish=_refit_to_median),
        "least median of squares, for up to half outliers",
    ),
}
"""By name: recipe and one line about it. RES-RANSAC draws a tenth of its trials before it has priors (thesis 4.6.2);
LMedS assumes half outliers (4.4.1)."""
