"""Robust estimation of fundamental matrices (thesis, chapter 4).

An estimator is a `loop.Recipe`: size and priors of the samples, pre-test, score, stopping rules, local optimization and
final fit. In the order of a run:

1. `points` checks and scales the matches.
2. `loop` draws `samples`; `solvers` compute models, which it pre-tests (`pretests`) and scores (`scores`) until a
   stopping rule holds.
3. `refits` computes the final F.
4. `estimate` asks whether the support can be chance (`a_contrario`) and whether the matches determine F (`degeneracy`).

`lev_ransac` is the program's estimator, `rays` the one for known lenses, `recipes` has the thesis's.

In all modules `points` are (N, 4) matches x1, y1, x2, y2 in random order and of magnitude about 1; `F` is (3, 3) and
`f` its (9,) entries by rows; `threshold` is the largest distance of an inlier in the unit of the points. The same seed
gives the same bytes. docs/symbols.md has the symbols of the thesis and their names here.
"""

from collections.abc import Callable
from functools import partial

from sfm_app.fundamental.estimate import assess_fundamental, estimate_with, fit_by_recipe
from sfm_app.fundamental.lev_ransac import fit_lev_ransac
from sfm_app.fundamental.points import check_points
from sfm_app.fundamental.recipes import RECIPES
from sfm_app.settings import EpipolarSettings
from sfm_app.types import EpipolarFit, Rejected
from sfm_app.types.arrays import FloatArray

FitFundamentalLike = Callable[[FloatArray, FloatArray, EpipolarSettings, int], EpipolarFit | Rejected]

ESTIMATORS: dict[str, tuple[FitFundamentalLike, str]] = {
    "lev-ransac": (fit_lev_ransac, "samples guided by Cook's distances, local optimization, robust refit; the default"),
    **{name: (partial(fit_by_recipe, recipe=recipe), about) for name, (recipe, about) in RECIPES.items()},
}
"""By name: the estimator and one line about it."""

__all__ = ["ESTIMATORS", "FitFundamentalLike", "assess_fundamental", "check_points", "estimate_with"]
