"""Algorithm 1 step by step: residuals, Cook's distances and priors at every new best model."""

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sfm_app.fundamental.leverage import cook_distances, leverages, mad_sigma, priors, studentized_residuals
from sfm_app.fundamental.points import Matches, prepare
from sfm_app.fundamental.refits import fit_eight_point, refine_sampson
from sfm_app.fundamental.samples import (
    SAMPLE_SIZE,
    RandomState,
    draw_uniform,
    draw_weighted,
    random_state,
    required_trials,
)
from sfm_app.fundamental.scores import squared_distances
from sfm_app.fundamental.solvers import MOST_MODELS, solve_sample
from sfm_app.settings import EpipolarSettings

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class BestModel:
    """Quantities per match when a new best model has been found."""

    trial: int
    residuals_px: FloatArray
    """(N,) Sampson distances."""
    cook: FloatArray
    """(N,) Cook's distances."""
    priors: FloatArray
    """(N,) p(v_i), largest value 1."""


def trace(x1: FloatArray, x2: FloatArray, options: EpipolarSettings, seed: int, *, guided: bool) -> Iterator[BestModel]:
    """Yield every new best model of a search, with samples drawn by the priors (LEV-RANSAC) or uniformly (RANSAC).

    The search ends by Eq. 3.19 alone, so it also shows what happens after the priors have converged.
    """
    matches, state = prepare(x1, x2, seed), random_state(seed)
    points, threshold = matches.points, options.max_error_px / matches.unit_px
    cumulative, lowest = np.empty(0), math.inf
    trial, limit = 0, float(options.max_trials)
    while trial < limit:
        trial += 1
        models = _candidates(points, state, cumulative)
        penalties = [float(np.minimum(np.sqrt(squared_distances(points, f)), threshold).sum()) for f in models]
        if min(penalties, default=math.inf) >= lowest:
            continue
        lowest, f = min(penalties), models[int(np.argmin(penalties))]
        residuals = np.sqrt(squared_distances(points, f))
        fitted = residuals <= threshold
        leverage = leverages(points, f, fitted)
        cook = cook_distances(studentized_residuals(residuals, leverage, fitted), leverage)
        validity = priors(cook, mad_sigma(cook))
        cumulative = np.cumsum(validity) if guided else cumulative
        limit = min(limit, required_trials(float(fitted.mean()) ** SAMPLE_SIZE, options.confidence))
        yield BestModel(trial, *_to_caller_order(matches, residuals * matches.unit_px, cook, validity))


def refits(
    x1: FloatArray, x2: FloatArray, options: EpipolarSettings, repeats: int, seed: int
) -> Iterator[dict[str, float]]:
    """Yield the mean residual in px of a 7-point model of a random sample and of refits to its inliers (Figure 4.4)."""
    matches, state = prepare(x1, x2, seed), random_state(seed)
    points, threshold = matches.points, options.max_error_px / matches.unit_px
    done = 0
    while done < repeats:
        models = _candidates(points, state, np.empty(0))
        if not models:
            continue
        minimal = max(models, key=lambda f: np.count_nonzero(squared_distances(points, f) <= threshold**2))
        inliers = squared_distances(points, minimal) <= threshold**2
        if np.count_nonzero(inliers) < 8:
            continue
        done += 1
        linear = fit_eight_point(points, inliers.astype(np.float64))
        nonlinear = refine_sampson(points[inliers], linear)
        fits = {"7-point": minimal, "8-point refit": linear, "Sampson refit": nonlinear}
        yield {
            name: float(np.sqrt(squared_distances(points, np.ravel(F))).mean()) * matches.unit_px
            for name, F in fits.items()
        }


def _candidates(points: FloatArray, state: RandomState, cumulative: FloatArray) -> list[FloatArray]:
    """Return the one to three models through one sample."""
    sample, models = np.empty(SAMPLE_SIZE, np.int64), np.empty((MOST_MODELS, 9))
    if not (len(cumulative) and draw_weighted(state, cumulative, sample)):
        draw_uniform(state, len(points), sample)
    return [models[k].copy() for k in range(solve_sample(points, sample, models))]


def _to_caller_order(matches: Matches, *values: FloatArray) -> Iterator[FloatArray]:
    """Reorder values from the shuffled order of `Matches` back to the caller's."""
    return (value[matches.rows] for value in values)
