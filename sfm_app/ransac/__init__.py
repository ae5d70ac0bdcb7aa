"""Robust estimation of fundamental matrices (thesis, chapter 4).

An estimator is a `loop.Recipe`: a way to sample, to score, to stop and to refit. `loop.search` runs it,
`verdict.estimate` judges what it found; `verdict.estimate_with` does the same for the searches of other libraries. From
the sample to the answer: `points`, `sampling`, `minimal`, `scoring`, `search`, `leverage`, `stopping`, `refit`,
`chance`, `degeneracy`.
"""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from sfm_app.ransac.lev_ransac import fit_lev_ransac
from sfm_app.ransac.lev_ransac_thesis import fit_lev_ransac_thesis, fit_msac
from sfm_app.ransac.points import check_points
from sfm_app.ransac.verdict import estimate_with, judge
from sfm_app.settings import EpipolarSettings
from sfm_app.types import EpipolarFit, Rejected

FloatArray = NDArray[np.float64]
FitFundamentalLike = Callable[[FloatArray, FloatArray, EpipolarSettings, int], EpipolarFit | Rejected]

ESTIMATORS: dict[str, tuple[FitFundamentalLike, str]] = {
    "lev-ransac": (fit_lev_ransac, "samples guided by Cook's distances, local optimisation, robust refit; the default"),
    "lev-ransac-thesis": (fit_lev_ransac_thesis, "Algorithm 1 of the thesis to the letter"),
    "msac": (fit_msac, "uniform samples, truncated squared error"),
}
"""Name, way to fit, and one line about it."""

__all__ = ["ESTIMATORS", "FitFundamentalLike", "check_points", "estimate_with", "judge"]
