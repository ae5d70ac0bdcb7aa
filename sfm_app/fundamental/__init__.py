"""Robust estimation of fundamental matrices (thesis, chapter 4).

An estimator is an `estimator_config.Recipe`: sampler, solver, score, verifier, stopping rule and final fit.
`loop.search` runs it, `estimate.estimate` judges its model, and `estimate.estimate_with` judges the models of other
libraries. `lev_ransac` is the estimator that the program uses; `estimator_configs` has the others.

From matches to the answer, in the order of a run:

1. `points`: check and scale the matches.
2. `loop` and `inner_loop`: draw (`sampling`), solve (`solvers`), test and score (`verification`, `scoring`), until
   `sampling.stopping` or `sampling.termination` ends the search; `best_model` holds the best model so far.
3. `refine`: the final fit.
4. `estimate`: could the support be chance (`verification.a_contrario`), and do the matches determine F (`degeneracy`)?

docs/symbols.md has the symbols of the thesis and their names here.
"""

from collections.abc import Callable

from sfm_app.fundamental.estimate import estimate_with, judge
from sfm_app.fundamental.lev_ransac import fit_lev_ransac
from sfm_app.fundamental.points import check_points
from sfm_app.fundamental.recipes import RECIPES, classical_estimator
from sfm_app.settings import EpipolarSettings
from sfm_app.types import EpipolarFit, Rejected
from sfm_app.types.arrays import FloatArray

FitFundamentalLike = Callable[[FloatArray, FloatArray, EpipolarSettings, int], EpipolarFit | Rejected]

ESTIMATORS: dict[str, tuple[FitFundamentalLike, str]] = {
    "lev-ransac": (fit_lev_ransac, "samples guided by Cook's distances, local optimization, robust refit; the default"),
    **{name: (classical_estimator(name), about) for name, (_, about) in RECIPES.items()},
}
"""By name: the function that fits, and one line about it."""

__all__ = ["ESTIMATORS", "FitFundamentalLike", "check_points", "estimate_with", "judge"]
