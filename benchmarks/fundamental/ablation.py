"""`lev-ransac` with one part switched off at a time: the contribution of each part."""

from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.common.timing import Method
from sfm_app.fundamental.estimate import fit_by_recipe
from sfm_app.fundamental.lev_ransac import PRODUCTION
from sfm_app.fundamental.leverage import prior_validity
from sfm_app.fundamental.loop import Recipe
from sfm_app.fundamental.pretests import FullScoring, Sprt
from sfm_app.fundamental.refits import refit_sampson
from sfm_app.fundamental.scores import msac
from sfm_app.settings import EpipolarSettings
from sfm_app.types import EpipolarFit

FloatArray = NDArray[np.float64]

WHOLE = "lev-ransac"
ABLATIONS: dict[str, dict[str, Any]] = {
    "uniform samples": {"validity": None},
    "all samples by the priors": {"guided_share": 1.0},
    "no samples of the rest": {"rest_share": 0.0},
    "sigma from all matches": {"validity": partial(prior_validity, sigma_from_inliers=False)},
    "a look after every sample": {"batch": 1},
    "stops by Eq. 3.19 only": {"patience": None, "least_trials": 0},
    "2000 idle samples for any evidence": {"patience": lambda *_: 2000.0},
    "one score, coarse": {"fine_score": None},
    "one score, truncated squares": {"fine_score": None, "score": msac},
    "no local optimization": {"improve": None, "fine_score": None},
    "no plane and parallax": {"recover": None},
    "no orientation test": {"oriented": False},
    "no bail-out": {"pretest": FullScoring},
    "SPRT instead of bail-out": {"pretest": Sprt},
    "least squares on the inliers last": {"finish": refit_sampson},
}
"""Name of the missing part, and the fields of the recipe that switch it off."""


def ablated_estimators(options: EpipolarSettings) -> dict[str, Method]:
    """Return the whole estimator and one for every row of `ABLATIONS`, all called in the same way."""
    recipes = {WHOLE: PRODUCTION} | {name: replace(PRODUCTION, **fields) for name, fields in ABLATIONS.items()}
    return {name: _make_method(recipe, options) for name, recipe in recipes.items()}


def _make_method(recipe: Recipe, options: EpipolarSettings) -> Method:
    def fit(x1: FloatArray, x2: FloatArray, seed: int) -> tuple[FloatArray | None, int | None]:
        found = fit_by_recipe(x1, x2, options, seed, recipe)
        return (found.F, found.trials) if isinstance(found, EpipolarFit) else (None, None)

    return fit
