"""Algorithm 1 of the thesis as a frame: what an estimator is made of, and the loop that all of them share."""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sfm_app.ransac.chance import is_credible
from sfm_app.ransac.points import Matches
from sfm_app.ransac.sampling import SAMPLE_SIZE, RandomState, random_state
from sfm_app.ransac.scoring import Measure, Score, penalty, squared_distances
from sfm_app.ransac.search import Rules, next_better
from sfm_app.ransac.stopping import have_converged
from sfm_app.ransac.verification import OPEN, FullVerification, Gate, Verifier
from sfm_app.settings import EpipolarSettings

FloatArray = NDArray[np.float64]

Refine = Callable[[FloatArray, FloatArray, float], FloatArray]
"""(points, F, threshold) -> a better F."""
Recover = Callable[[FloatArray, FloatArray, float, Measure, Gate, RandomState], FloatArray | None]
"""(points, F, threshold, measure, gate, random generator) -> another F that the samples may have missed, or None."""
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
    least_trials: int = 0
    """Samples that are drawn even if fewer would do by 3.19."""
    stop_on_convergence: bool = False
    """End when the priors have converged (thesis 4.18)."""
    patience: int | None = None
    """End after this many samples without a better model, unless the best one may be luck."""
    improve: Refine | None = None
    """Local optimisation of every new best model of a sample."""
    fine_score: Score | None = None
    """The penalty by which improved models compete, apart from those of samples; None: all compete by `score`."""
    recover: Recover | None = None
    """A last attempt from the best model, by means other than samples of matches."""
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
    points, threshold = matches.points, options.max_error_px / matches.unit_px
    count = len(points)
    if count < recipe.sample_size:
        return None
    best, test, state = _Best(points, threshold, recipe), recipe.verifier(count, recipe.sample_size), random_state(seed)
    priors, guided, model = np.ones(count), 0.0, np.empty(9)
    circle = np.asfortranarray(np.vstack([points, points])) if test.gate.random_start else points
    share, patience = recipe.assumed_share or 0.0, recipe.patience or options.max_trials
    trials, idle, limit = 0, 0, _trials_allowed(test, share, options, recipe)
    while trials < limit:
        left = min(limit - trials, patience - idle, test.review)
        rules = Rules(recipe.sample_size, recipe.oriented, guided)
        weights = np.cumsum(priors)
        drawn, found = next_better(circle, weights, rules, best.measure, test.gate, best.to_beat, left, state, model)
        trials, idle = trials + drawn, idle + drawn
        test.learn(drawn)
        is_new = found < best.to_beat and best.meets(model.copy(), found)
        if is_new:
            idle, seen = 0, best.inlier_share()
            share = recipe.assumed_share or max(share, seen)
            test.expect(seen)
        limit = _trials_allowed(test, share, options, recipe)
        if is_new and recipe.validity is not None and trials >= recipe.guided_after * limit:
            before, priors, guided = priors, recipe.validity(points, best.f, threshold), recipe.guided_share
            if recipe.stop_on_convergence and have_converged(before, priors):
                break
        if patience <= idle and trials < limit:
            if best.is_known and is_credible(points, best.f, threshold):
                break
            idle = 0
    if best.is_known and recipe.recover is not None:
        gate = OPEN if test.gate.random_start else test.gate
        best.meets_another(recipe.recover(points, best.f.reshape(3, 3), threshold, best.measure, gate, state))
    return Hypothesis(best.f.reshape(3, 3), trials) if best.is_known else None


class _Best:
    """The best model so far and what the next one has to beat.

    Algorithm 1 starts with Q* = 0 in print; as a penalty that is to fall it has to start at infinity.
    """

    def __init__(self, points: FloatArray, threshold: float, recipe: Recipe) -> None:
        self._points, self._threshold, self._recipe = points, threshold, recipe
        self._fine = None if recipe.fine_score is None else recipe.fine_score(points, threshold, None)
        self._lowest = math.inf
        self.measure = recipe.score(points, threshold, None)
        """The penalty of models of samples."""
        self.to_beat = math.inf
        """By the model of a sample."""
        self.f: FloatArray = np.zeros(9)

    @property
    def is_known(self) -> bool:
        return self._lowest < math.inf

    def inlier_share(self) -> float:
        return float(np.mean(squared_distances(self._points, self.f) <= self._threshold**2))

    def meets(self, model: FloatArray, penalised: float) -> bool:
        """Whether the best model of a sample, or what local optimisation makes of it, is the best model of all."""
        if self._fine is not None:
            self.to_beat = penalised
            return self.meets_another(model.reshape(3, 3))
        self.f, self._lowest = model, penalised
        if self._recipe.improve is not None:
            improved = self._improve(model.reshape(3, 3))
            score = penalty(self._points, 0, improved, self.measure, math.inf, OPEN)
            if score < penalised:
                self.f, self._lowest = improved, score
        self._measure_anew()
        self.to_beat = self._lowest
        return True

    def meets_another(self, F: FloatArray | None) -> bool:
        """Whether this model, locally optimised, is better by the fine penalty; it then is the best one."""
        if F is None:
            return False
        improved, measure = self._improve(F), self._fine or self.measure
        score = penalty(self._points, 0, improved, measure, self._lowest, OPEN)
        if score < self._lowest:
            self.f, self._lowest = improved, score
            return True
        return False

    def _improve(self, F: FloatArray) -> FloatArray:
        if self._recipe.improve is not None:
            F = self._recipe.improve(self._points, F, self._threshold)
        return np.asarray(np.ascontiguousarray(F).reshape(9) / np.linalg.norm(F))

    def _measure_anew(self) -> None:
        """MLESAC's penalty changes with every best model.

        One of before would be compared with those of another function, a flaw that the thesis names (4.4.1).
        """
        renewed = self._recipe.score(self._points, self._threshold, self.f)
        if renewed != self.measure:
            self.measure, self._lowest = renewed, penalty(self._points, 0, self.f, renewed, math.inf, OPEN)


def _trials_allowed(test: Verifier, share: float, options: EpipolarSettings, recipe: Recipe) -> int:
    needed = max(test.trials_needed(share, options.confidence), recipe.least_trials)
    return math.ceil(min(options.max_trials, needed))
