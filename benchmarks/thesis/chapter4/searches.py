"""The search of an estimator alone, as in Algorithm 1: no final refit and no check of the result."""

import numpy as np
from numpy.typing import NDArray

from benchmarks.common.metrics import CAP_PX, mean_sampson_px
from sfm_app.fundamental.lev_ransac import PRODUCTION
from sfm_app.fundamental.loop import Hypothesis, Recipe, run_loop
from sfm_app.fundamental.points import Matches, prepare
from sfm_app.fundamental.recipes import RECIPES
from sfm_app.settings import EpipolarSettings
from sfm_app.synthetic.correspondences import TwoViews

FloatArray = NDArray[np.float64]


class Search:
    """A method for `timing.take_turns` that keeps its results for the refit, which is not timed."""

    def __init__(self, recipe: Recipe, options: EpipolarSettings) -> None:
        self._recipe, self._options = recipe, options
        self._found: list[tuple[Matches, Hypothesis | None]] = []

    def __call__(self, x1: FloatArray, x2: FloatArray, seed: int) -> tuple[FloatArray | None, int | None]:
        matches = prepare(x1, x2, seed)
        found = run_loop(matches, self._options, seed, self._recipe)
        self._found.append((matches, found))
        return (None, None) if found is None else (matches.to_pixels(found.F), found.trials)

    def errors_after_refit_px(self, pairs: list[TwoViews]) -> FloatArray:
        """Return (N,) capped errors of the last calls, one per pair, after the estimator's own final fit."""
        errors = []
        for pair, (matches, found) in zip(pairs, self._found[-len(pairs) :], strict=True):
            F = None
            if found is not None:
                threshold = self._options.max_error_px / matches.unit_px
                F = matches.to_pixels(self._recipe.finish(matches.points, found.F, threshold))
            errors.append(min(mean_sampson_px(F, pair.exact_x1, pair.exact_x2), CAP_PX))
        self._found.clear()
        return np.array(errors)


def searches(names: list[str], options: EpipolarSettings) -> dict[str, Search]:
    """Return searches by the name of the estimator."""
    recipes = {"lev-ransac": PRODUCTION} | {name: recipe for name, (recipe, _) in RECIPES.items()}
    return {name: Search(recipes[name], options) for name in names}
