"""Algorithm 1 of the thesis as a frame: what an estimator is made of, and the loop that all of them share."""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sfm_app.ransac.chance import is_credible
from sfm_app.ransac.points import Matches
from sfm_app.ransac.sampling import SAMPLE_SIZE, random_state
from sfm_app.ransac.scoring import Score, penalty, squared_distances
from sfm_app.ransac.search import Rules, next_better
from sfm_app.ransac.stopping import have_converged
from sfm_app.ransac.verification import OPEN, FullVerification, Verifier
from sfm_app.settings import EpipolarSettings

FloatArray = NDArray[np.float64]

Refine = Callable[[FloatArray, FloatArray, float], FloatArray]
"""(points, F, threshold) -> a better F."""
Validity = Callable[[FloatArray, FloatArray, float], FloatArray]
"""(points, f, threshold) -> p(v_i), (N,) >= 0, at least one of them > 0."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Recipe:
    """What sets one estimator apart from the next: sampler, solver, score, verifier, stopping rule, final fit."""

    score: Score
    """The penalty that the best model has least of (see `scoring` and `mixture`)."""
    finish: Refine
    """The final fit, from the best model of the loop."""
    sample_size: int = SAMPLE_SIZE
    """7: all models through seven matches; 8: the linear one through eight."""
    validity: Validity | None = None
    """Priors from a new best model; None samples uniformly throughout."""
    guided_share: float = 1.0
    """Share of the samples that are drawn by the priors."""
    guided_after: float = 0.0
    """Share of the trials before the first priors."""
    verifier: Callable[[int, int], Verifier] = FullVerification
    """(number of matches, sample size) -> the test of hypotheses before they are scored in full."""
    assumed_share: float | None = None
    """Inliers that the number of trials is made for (3.19); None: those of the best model."""
    stop_on_convergence: bool = False
    """End when the priors have converged (thesis 4.18)."""
    patience: int | None = None
    """End after this many samples without a better model, unless the best one may be luck."""
    improve: Refine | None = None
    """Local optimisation of every new best model."""
    oriented: bool = False
    """Drop models that put a sampled point behind a camera before they are scored."""


@dataclass(frozen=True, slots=True, eq=False)
class Hypothesis:
    """The best model of a search."""

    F: FloatArray
    """(3, 3) in the frame of `Matches`."""
    trials: int


def search(matches: Matches, options: EpipolarSettings, seed: int, recipe: Recipe) -> Hypothesis | None:
    """Draw samples, by the priors, until one of the stopping rules holds (thesis, Algorithm 1)."""
    if len(matches.points) < recipe.sample_size:
        return None
    return _Search(matches, options, seed, recipe).run()


class _Search:
    """Algorithm 1 at work: the best model so far, and what follows from it for the samples to come."""

    best: FloatArray | None
    """(9,), and its penalty `lowest`."""
    share: float
    """Of inliers, in the best model that was ever seen or as assumed."""
    limit: int
    """Samples, by 3.19 and the settings."""
    first_priors: int
    """Samples before the priors are first estimated."""

    def __init__(self, matches: Matches, options: EpipolarSettings, seed: int, recipe: Recipe) -> None:
        self.points, self.threshold = matches.points, options.max_error_px / matches.unit_px
        self.options, self.recipe = options, recipe
        self.test = recipe.verifier(len(self.points), recipe.sample_size)
        self.measure = recipe.score(self.points, self.threshold, None)
        # in print Q* starts at 0; as a penalty that is to fall it has to start at infinity
        self.best, self.lowest, self.share = None, math.inf, recipe.assumed_share or 0.0
        self.priors, self.guided_share = np.ones(len(self.points)), 0.0
        self.cumulative = np.cumsum(self.priors)
        self.state, self.model = random_state(seed), np.empty(9)
        self.circle = np.vstack([self.points] * 2) if self.test.gate.random_start else self.points
        self.trials = self.idle = 0
        self._look_ahead()

    def run(self) -> Hypothesis | None:
        """Go on until the samples are used up, the priors have converged, or patience has run out."""
        while self.trials < self.limit:
            better = self._draw()
            if self._guide(better):
                break
            if self.idle == self.recipe.patience:
                if self.best is not None and is_credible(self.points, self.best, self.threshold):
                    break
                self.idle = 0
        return None if self.best is None else Hypothesis(self.best.reshape(3, 3), self.trials)

    def _draw(self) -> bool:
        """Samples until one is better, which is then adopted, or until something else has to be decided."""
        left = min(self.limit - self.trials, self.test.review)
        if self.recipe.patience is not None:
            left = min(left, self.recipe.patience - self.idle)
        if self.trials < self.first_priors:
            left = min(left, self.first_priors - self.trials)
        rules = Rules(self.recipe.sample_size, self.recipe.oriented, self.guided_share)
        parts = rules, self.measure, self.test.gate
        drawn, found = next_better(self.circle, self.cumulative, *parts, self.lowest, left, self.state, self.model)
        self.trials += drawn
        self.idle += drawn
        self.test.learn(drawn)
        better = found < self.lowest
        if better:
            self._adopt(self.model.copy(), found)
        self._look_ahead()
        return better

    def _adopt(self, model: FloatArray, found: float) -> None:
        """A better model, perhaps improved further; the measure and the test are made anew for it."""
        points, threshold, recipe = self.points, self.threshold, self.recipe
        self.best, self.lowest, self.idle = model, found, 0
        if recipe.improve is not None:
            refined = np.ascontiguousarray(recipe.improve(points, model.reshape(3, 3), threshold)).reshape(9)
            refined /= np.linalg.norm(refined)
            score = penalty(points, refined, self.measure, math.inf, OPEN)
            if score < found:
                self.best, self.lowest = refined, score
        measure = recipe.score(points, threshold, self.best)
        if measure != self.measure:
            # MLESAC's function changes with the best model; the thesis names the flaw of comparing across the change
            self.measure, self.lowest = measure, penalty(points, self.best, measure, math.inf, OPEN)
        share = float(np.mean(squared_distances(points, self.best) <= threshold * threshold))
        self.share = recipe.assumed_share or max(self.share, share)
        self.test.expect(share)

    def _look_ahead(self) -> None:
        needed = self.test.trials_needed(self.share, self.options.confidence)
        self.limit = math.ceil(min(self.options.max_trials, needed))
        self.first_priors = math.ceil(self.recipe.guided_after * self.limit)

    def _guide(self, better: bool) -> bool:
        """Priors from a new best model; whether they say that the search is over."""
        recipe = self.recipe
        if recipe.validity is None or self.best is None or self.trials < self.first_priors:
            return False
        if not better and self.guided_share > 0:
            return False
        before, self.priors = self.priors, recipe.validity(self.points, self.best, self.threshold)
        self.cumulative, self.guided_share = np.cumsum(self.priors), recipe.guided_share
        return recipe.stop_on_convergence and have_converged(before, self.priors)
