"""The best model of a search, and the penalties that the next one has to beat.

Thesis 4.7.5, lines 6 and 7 of Algorithm 1 (F*, Q*). Two scores at once, and separate bars for the two kinds of samples,
are ours.
"""

import math

import numpy as np
from numpy.typing import NDArray

from sfm_app.ransac.estimator_config import Recipe
from sfm_app.ransac.inner_loop import GUIDED, UNGUIDED
from sfm_app.ransac.scoring.robust_costs import penalty, squared_distances
from sfm_app.ransac.verification.pretests import LENIENCE, NO_PRETEST

FloatArray = NDArray[np.float64]


class BestModel:
    """The best model so far.

    Algorithm 1 starts with Q* = 0 in print; a penalty to be minimized has to start at infinity.
    """

    f: FloatArray
    """(9,) entries of F, norm 1; F* of the thesis."""
    to_beat: FloatArray
    """(2,) bars, one per kind of sample: penalties that models must stay below (see `inner_loop.draw_until_better`)."""
    samples: FloatArray
    """(2, 9) for each kind, the last model of a sample that was below the bar."""

    def __init__(self, points: FloatArray, threshold: float, recipe: Recipe) -> None:
        self._points, self._threshold, self._recipe = points, threshold, recipe
        self.loss = recipe.score(points, threshold, None)
        self._fine = None if recipe.fine_score is None else recipe.fine_score(points, threshold, None)
        self.f, self._lowest = np.zeros(9), math.inf
        self.to_beat, self.samples = np.full(2, math.inf), np.zeros((2, 9))

    def __bool__(self) -> bool:
        """Return whether a model was found yet."""
        return self._lowest < math.inf

    def inlier_share(self) -> float:
        """Return the share of all matches that are within the threshold."""
        return float(np.mean(squared_distances(self._points, self.f) <= self._threshold**2))

    def update(self, kind: int) -> bool:
        """Update the best model and the bars with the sample that was below the bar of its kind.

        With one score the sample is the new best model, and its penalty the bar of both kinds. With two scores its
        model is locally optimized and has to win by the finer score; each kind then has a bar of its own.

        Returns:
            Whether the best model changed.
        """
        if self._fine is None:
            self._replace(self.samples[kind].copy(), float(self.to_beat[kind]))
            self._set_common_bar()
            return True
        if not self.replace_if_better(self.samples[kind].reshape(3, 3)):
            return False
        self._set_unguided_bar()
        return True

    def _set_common_bar(self) -> None:
        """Set both bars to the penalty of the best model."""
        self.to_beat[:] = self._lowest

    def _set_unguided_bar(self) -> None:
        """Set the bar of unguided samples to `LENIENCE` of the support of the best guided sample.

        Support is the penalty of a model without any inliers minus the penalty of the model.
        """
        nothing = len(self._points) * self.loss.worst
        self.to_beat[UNGUIDED] = nothing - LENIENCE * (nothing - self.to_beat[GUIDED])

    def _replace(self, model: FloatArray, found: float) -> None:
        """Replace the best model by that of a sample, locally optimized where this lowers the penalty."""
        self.f, self._lowest = model, found
        if self._recipe.improve is not None:
            improved = self._improve(model.reshape(3, 3))
            score = penalty(self._points, 0, improved, self.loss, math.inf, NO_PRETEST)
            if score < found:
                self.f, self._lowest = improved, score
        self._rescore()

    def replace_if_better(self, F: FloatArray) -> bool:
        """Replace the best model by the optimized F (3, 3) if its finer penalty is lower; return whether it is."""
        improved = self._improve(F)
        score = penalty(self._points, 0, improved, self._fine or self.loss, self._lowest, NO_PRETEST)
        if score < self._lowest:
            self.f, self._lowest = improved, score
            return True
        return False

    def _improve(self, F: FloatArray) -> FloatArray:
        if self._recipe.improve is not None:
            F = self._recipe.improve(self._points, F, self._threshold)
        return np.asarray(np.ascontiguousarray(F).reshape(9) / np.linalg.norm(F))

    def _rescore(self) -> None:
        """Score the best model again if the penalty changed: that of MLESAC depends on the best model.

        The thesis notes that comparing penalties across such a change is not always sensible.
        """
        renewed = self._recipe.score(self._points, self._threshold, self.f)
        if renewed != self.loss:
            self.loss, self._lowest = renewed, penalty(self._points, 0, self.f, renewed, math.inf, NO_PRETEST)
