"""Algorithm 1 of the thesis as a frame: what an estimator is made of, and the loop that all of them share."""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sfm_app.ransac.chance import is_credible
from sfm_app.ransac.points import Matches
from sfm_app.ransac.sampling import SAMPLE_SIZE, random_state
from sfm_app.ransac.scoring import bail_out_table, penalty, squared_distances
from sfm_app.ransac.search import next_better
from sfm_app.ransac.stopping import have_converged, trials_needed
from sfm_app.settings import EpipolarSettings

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

NO_TABLE: IntArray = np.zeros(0, dtype=np.int64)

Refine = Callable[[FloatArray, FloatArray, float], FloatArray]
"""(points, F, threshold) -> a better F."""
Validity = Callable[[FloatArray, FloatArray, float], FloatArray]
"""(points, f, threshold) -> p(v_i), (N,) >= 0, at least one of them > 0."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Recipe:
    """What sets one estimator apart from the next."""

    score: int
    """Which penalty (see `scoring`)."""
    finish: Refine
    """The final fit, from the best model of the loop."""
    validity: Validity | None = None
    """Priors from a new best model; None samples uniformly throughout."""
    guided_share: float = 1.0
    """Share of the samples that are drawn by the priors."""
    stop_on_convergence: bool = False
    """End when the priors have converged (thesis 4.18)."""
    patience: int | None = None
    """End after this many samples without a better model, unless the best one may be luck."""
    improve: Refine | None = None
    """Local optimisation of every new best model."""
    oriented: bool = False
    """Drop models that put a sampled point behind a camera before they are scored."""
    bail_out: bool = False
    """Leave hopeless hypotheses before all matches are scored."""


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
    if count < SAMPLE_SIZE:
        return None
    state, model, best = random_state(seed), np.empty(9), None
    priors, lowest, least = np.ones(count), math.inf, NO_TABLE
    trials, limit = 0, options.max_trials
    while trials < limit:
        guided = recipe.guided_share if recipe.validity is not None and best is not None else 0.0
        left = limit - trials if recipe.patience is None else min(limit - trials, recipe.patience)
        rules = (guided, recipe.oriented, recipe.score)
        drawn, found = next_better(points, np.cumsum(priors), rules, threshold, lowest, least, left, state, model)
        trials += drawn
        if not found < lowest:
            if trials < limit and best is not None and is_credible(points, best, threshold):
                break
            continue
        best, lowest = _improved(points, model.copy(), found, threshold, recipe)
        share = float(np.mean(squared_distances(points, best) <= threshold * threshold))
        limit = math.ceil(min(limit, trials_needed(share, options.confidence)))
        least = bail_out_table(count, share) if recipe.bail_out else NO_TABLE
        if recipe.validity is not None:
            before, priors = priors, recipe.validity(points, best, threshold)
            if recipe.stop_on_convergence and have_converged(before, priors):
                break
    return None if best is None else Hypothesis(best.reshape(3, 3), trials)


def _improved(
    points: FloatArray, best: FloatArray, lowest: float, threshold: float, recipe: Recipe
) -> tuple[FloatArray, float]:
    """The locally optimised model if its penalty is smaller, else the one it started from."""
    if recipe.improve is None:
        return best, lowest
    refined = np.ascontiguousarray(recipe.improve(points, best.reshape(3, 3), threshold)).reshape(9)
    refined /= np.linalg.norm(refined)
    score = penalty(points, refined, recipe.score, threshold, math.inf, NO_TABLE)
    return (refined, score) if score < lowest else (best, lowest)
