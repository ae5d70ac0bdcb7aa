"""Algorithm 1 of the thesis as a frame: what an estimator is made of, and the loop that all of them share."""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sfm_app.ransac.chance import is_credible
from sfm_app.ransac.points import Matches
from sfm_app.ransac.sampling import SAMPLE_SIZE, random_state
from sfm_app.ransac.scoring import Measure, Score, penalty, squared_distances
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
    """Draw samples, by the priors, until one of the stopping rules holds (thesis, Algorithm 1).

    The algorithm starts with Q* = 0 in print; as a penalty that is to fall it has to start at infinity.
    """
    points, threshold = matches.points, options.max_error_px / matches.unit_px
    count = len(points)
    if count < recipe.sample_size:
        return None
    test, measure = recipe.verifier(count, recipe.sample_size), recipe.score(points, threshold, None)
    state, model, best, lowest = random_state(seed), np.empty(9), None, math.inf
    priors, guided = np.ones(count), 0.0
    circle = np.vstack([points, points]) if test.gate.random_start else points
    share = recipe.assumed_share or 0.0
    patience = recipe.patience or options.max_trials
    trials, idle, limit = 0, 0, _trials_allowed(test, share, options)
    while trials < limit:
        left = min(limit - trials, patience - idle, test.review)
        rules = Rules(recipe.sample_size, recipe.oriented, guided)
        drawn, found = next_better(circle, np.cumsum(priors), rules, measure, test.gate, lowest, left, state, model)
        trials, idle = trials + drawn, idle + drawn
        test.learn(drawn)
        if not found < lowest:
            limit = _trials_allowed(test, share, options)
            if idle >= patience and trials < limit:
                if best is not None and is_credible(points, best, threshold):
                    break
                idle = 0
            continue
        best, lowest = _improved(points, model.copy(), found, threshold, recipe, measure)
        measure, lowest = _measured_anew(points, best, lowest, threshold, recipe, measure)
        idle = 0
        seen = float(np.mean(squared_distances(points, best) <= threshold * threshold))
        share = recipe.assumed_share or max(share, seen)
        test.expect(seen)
        limit = _trials_allowed(test, share, options)
        if recipe.validity is not None and trials >= recipe.guided_after * limit:
            before, priors, guided = priors, recipe.validity(points, best, threshold), recipe.guided_share
            if recipe.stop_on_convergence and have_converged(before, priors):
                break
    return None if best is None else Hypothesis(best.reshape(3, 3), trials)


def _trials_allowed(test: Verifier, share: float, options: EpipolarSettings) -> int:
    return math.ceil(min(options.max_trials, test.trials_needed(share, options.confidence)))


def _improved(
    points: FloatArray, best: FloatArray, lowest: float, threshold: float, recipe: Recipe, measure: Measure
) -> tuple[FloatArray, float]:
    """The locally optimised model if its penalty is smaller, else the one it started from."""
    if recipe.improve is None:
        return best, lowest
    refined = np.ascontiguousarray(recipe.improve(points, best.reshape(3, 3), threshold)).reshape(9)
    refined /= np.linalg.norm(refined)
    score = penalty(points, refined, measure, math.inf, OPEN)
    return (refined, score) if score < lowest else (best, lowest)


def _measured_anew(
    points: FloatArray, best: FloatArray, lowest: float, threshold: float, recipe: Recipe, measure: Measure
) -> tuple[Measure, float]:
    """The measure after a new best model, and that model's penalty by it.

    MLESAC's changes with every best model. A penalty of before would be compared with those of another function, a
    flaw that the thesis names (4.4.1).
    """
    renewed = recipe.score(points, threshold, best)
    if renewed == measure:
        return measure, lowest
    return renewed, penalty(points, best, renewed, math.inf, OPEN)
