"""Algorithm 1 of the thesis: the loop that all estimators share."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sfm_app.ransac.best_model import BestModel
from sfm_app.ransac.estimator_config import Recipe
from sfm_app.ransac.inner_loop import SamplingPlan, draw_until_better
from sfm_app.ransac.points import Matches
from sfm_app.ransac.sampling.minimal_samples import random_state
from sfm_app.ransac.sampling.stopping import has_converged
from sfm_app.ransac.scoring.robust_costs import squared_distances
from sfm_app.ransac.verification.pretests import NO_PRETEST
from sfm_app.settings import EpipolarSettings

FloatArray = NDArray[np.float64]

_EXPLAINED = 2.0
"""Thresholds within which a match counts as explained by the best model. Chosen by hand; halved and doubled by
`benchmarks.sensitivity`."""


@dataclass(frozen=True, slots=True, eq=False)
class Hypothesis:
    """The best model of a search, and the number of samples drawn."""

    F: FloatArray
    """(3, 3) in the frame of `Matches`."""
    trials: int


def search(matches: Matches, options: EpipolarSettings, seed: int, recipe: Recipe) -> Hypothesis | None:
    """Draw samples by the priors until a stopping rule holds (thesis, Algorithm 1).

    Args:
        matches: the distinct matches of a pair.
        options: threshold, confidence, largest number of samples.
        seed: same seed, same result.
        recipe: the estimator.
    """
    if len(matches.points) < recipe.sample_size:
        return None
    return _Search(matches, options, seed, recipe).run()


class _Search:
    """The state of Algorithm 1: the best model so far, and from it the priors and limits for the next samples."""

    share: float
    """Largest share of inliers of any best model so far, or the assumed one."""
    limit: int
    """Largest number of samples, by (3.19) and the settings."""
    warmup_trials: int
    """Samples before the priors are first estimated."""
    patience: float
    """Samples without a better model after which the evidence for the best one is evaluated."""

    def __init__(self, matches: Matches, options: EpipolarSettings, seed: int, recipe: Recipe) -> None:
        self.points, self.threshold = matches.points, options.max_error_px / matches.unit_px
        self.options, self.recipe = options, recipe
        self.test = recipe.verifier(len(self.points), recipe.sample_size)
        self.best, self.share = BestModel(self.points, self.threshold, recipe), recipe.assumed_share or 0.0
        self.priors, self.state = np.ones(len(self.points)), random_state(seed)
        no_rest = np.zeros(1)
        equal = np.cumsum(self.priors)
        self.draws = SamplingPlan(recipe.sample_size, recipe.oriented, recipe.batch, 0.0, equal, 0.0, no_rest)
        twice = self.test.pretest.random_start
        self.circle = np.asfortranarray(np.vstack([self.points] * 2)) if twice else self.points
        self.trials, self.idle, self.has_priors = 0, 0, False
        self.patience = recipe.least_trials if recipe.patience is not None else math.inf
        self._update_limits()

    def run(self) -> Hypothesis | None:
        """Continue until the samples are used up, the priors have converged, or patience has run out."""
        while self.trials < self.limit:
            better = self._draw()
            if self._update_priors(better) or self._has_waited_enough():
                break
        if not self.best:
            return None
        self._recover()
        return Hypothesis(self.best.f.reshape(3, 3), self.trials)

    def _draw(self) -> bool:
        """Draw samples until a better model or the next decision; return whether the best model changed."""
        left = min(self.limit - self.trials, self.test.review, self.patience - self.idle)
        if self.trials < self.warmup_trials:
            left = min(left, self.warmup_trials - self.trials)
        best, before = self.best, self.best.to_beat.copy()
        parts = self.draws, best.loss, (self.test.pretest, self.test.lenient)  # guided, unguided
        drawn = draw_until_better(self.circle, *parts, best.to_beat, int(left), self.state, best.samples)
        self.trials += drawn
        self.idle += drawn
        self.test.learn(drawn)
        improved = np.flatnonzero(best.to_beat < before).tolist()
        better = any([best.update(kind) for kind in improved])  # noqa: C419  update both kinds
        if better:
            seen = best.inlier_share()
            self.idle, self.share = 0, self.recipe.assumed_share or max(self.share, seen)
            self.test.expect(seen)
            if self.recipe.patience is not None:
                self.patience = self.recipe.least_trials
        self._update_limits()
        return better

    def _update_limits(self) -> None:
        needed = max(self.test.required_trials(self.share, self.options.confidence), self.recipe.least_trials)
        self.limit = math.ceil(min(self.options.max_trials, needed))
        self.warmup_trials = math.ceil(self.recipe.warmup_share * self.limit)

    def _update_priors(self, better: bool) -> bool:
        """Set the priors after a new best model; return whether they have converged and end the search."""
        recipe = self.recipe
        if recipe.validity is None or not self.best or self.trials < self.warmup_trials:
            return False
        if not better and self.has_priors:
            return False
        self.has_priors = True
        before, self.priors = self.priors, recipe.validity(self.points, self.best.f, self.threshold)
        self.draws = self.draws._replace(guided_share=recipe.guided_share, priors=np.cumsum(self.priors))
        if recipe.rest_share > 0:
            rest = squared_distances(self.points, self.best.f) > (_EXPLAINED * self.threshold) ** 2
            self.draws = self.draws._replace(rest_share=recipe.rest_share, rest=np.cumsum(rest, dtype=np.float64))
        return recipe.stop_on_convergence and has_converged(before, self.priors)

    def _has_waited_enough(self) -> bool:
        """Return whether the best model has survived as many samples as its evidence requires."""
        if self.recipe.patience is None or self.idle < self.patience:
            return False
        if not self.best:
            self.patience += self.recipe.least_trials
            return False
        wanted = self.recipe.patience(self.points, self.best.f.reshape(3, 3), self.threshold)
        if math.isinf(wanted):  # support that may be chance must not guide the sampling
            self.draws = self.draws._replace(guided_share=0.0, rest_share=0.0)
        self.patience = math.ceil(min(wanted, self.options.max_trials))
        return self.patience <= self.idle

    def _recover(self) -> None:
        if self.recipe.recover is None:
            return
        pretest = NO_PRETEST if self.test.pretest.random_start else self.test.pretest
        F = self.best.f.reshape(3, 3)
        another = self.recipe.recover(self.points, F, self.threshold, self.best.loss, pretest, self.state)
        if another is not None:
            self.best.replace_if_better(another)
