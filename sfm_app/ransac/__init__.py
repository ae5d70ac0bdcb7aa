"""Robust estimation of fundamental matrices (thesis, chapter 4).

An estimator is a `recipe.Recipe`: what it samples, solves, scores and verifies with, when it stops, how it refits.
`loop.search` runs it, `verdict.estimate` judges what it found, and `verdict.estimate_with` what other libraries find.
`lev_ransac` is the estimator that the program uses, `recipes` has the others.

From the sample to the answer: `points`, `sampling`, `minimal`, `verification`, `sprt`, `scoring`, `mixture`, `search`,
`leverage`, `residuals`, `stopping`, `best`, `loop`, `planes`, `parallax`, `refit`, `reprojection`, `refits`, `chance`,
`degeneracy`; below them `design` and `eigen`.
"""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from sfm_app.ransac.estimate import estimate_with, judge
from sfm_app.ransac.estimator_configs import RECIPES, classical
from sfm_app.ransac.lev_ransac import fit_lev_ransac
from sfm_app.ransac.points import check_points
from sfm_app.settings import EpipolarSettings
from sfm_app.types import EpipolarFit, Rejected

FloatArray = NDArray[np.float64]
FitFundamentalLike = Callable[[FloatArray, FloatArray, EpipolarSettings, int], EpipolarFit | Rejected]

ESTIMATORS: dict[str, tuple[FitFundamentalLike, str]] = {
    "lev-ransac": (fit_lev_ransac, "samples guided by Cook's distances, local optimization, robust refit; the default"),
    **{name: (classical(name), about) for name, (_, about) in RECIPES.items()},
}
"""Name, way to fit, and one line about it."""

__all__ = ["ESTIMATORS", "FitFundamentalLike", "check_points", "estimate_with", "judge"]
