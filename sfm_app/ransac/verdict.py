"""From the best model of a search to the answer: a fit with its evidence, or a rejection with its reason."""

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sfm_app.geometry.distances import sampson_distance
from sfm_app.ransac.chance import MOST_FALSE_ALARMS, false_alarms_of, mismatch_distances
from sfm_app.ransac.degeneracy import find_degeneracy
from sfm_app.ransac.leverage import prior_validity
from sfm_app.ransac.loop import Recipe, search
from sfm_app.ransac.points import Matches, check_points, prepare
from sfm_app.ransac.refits import last_fit
from sfm_app.ransac.scoring import squared_distances
from sfm_app.settings import EpipolarSettings
from sfm_app.types import EpipolarFit, Rejected

FloatArray = NDArray[np.float64]

TOO_FEW_MATCHES = "too few matches"
NO_MODEL = "no model found"
TOO_FEW_INLIERS = "too few inliers"
CHANCE = "inliers no better than chance"
REASONS = (TOO_FEW_MATCHES, NO_MODEL, TOO_FEW_INLIERS, CHANCE)
"""Why a pair is rejected, in the order of the checks."""


def estimate(
    x1: ArrayLike, x2: ArrayLike, options: EpipolarSettings, seed: int, recipe: Recipe
) -> EpipolarFit | Rejected:
    """One fundamental matrix from matches of which many may be wrong.

    Args:
        x1: (N, 2) pixels.
        x2: (N, 2) pixels, row by row the partners of x1.
        options: threshold, confidence, most samples, fewest inliers.
        seed: same seed, same bytes.
        recipe: the estimator.

    Raises:
        ValueError: the points are not as above (see `check_points`).
    """
    first, second = check_points(x1, x2)
    matches = prepare(first, second, seed)
    if len(matches.points) < options.min_inliers:
        return Rejected(TOO_FEW_MATCHES)
    found = search(matches, options, seed, recipe)
    if found is None:
        return Rejected(NO_MODEL)
    threshold = options.max_error_px / matches.unit_px
    F = last_fit(options.refit, recipe.finish)(matches.points, found.F, threshold)
    if not np.isfinite(F).all():
        return Rejected(NO_MODEL)
    return _judge(first, second, matches, F, found.trials, options)


def _judge(
    x1: FloatArray, x2: FloatArray, matches: Matches, F: FloatArray, trials: int, options: EpipolarSettings
) -> EpipolarFit | Rejected:
    points, threshold = matches.points, options.max_error_px / matches.unit_px
    f = np.ascontiguousarray(F / np.linalg.norm(F)).reshape(9)
    distances = np.sqrt(squared_distances(points, f))
    inliers = distances <= threshold
    if np.count_nonzero(inliers) < options.min_inliers:
        return Rejected(TOO_FEW_INLIERS)
    wrong = mismatch_distances(points, f)
    if false_alarms_of(distances, wrong, threshold) > MOST_FALSE_ALARMS:
        return Rejected(CHANCE)
    F_px = matches.to_pixels(F)
    errors_px = sampson_distance(F_px, x1, x2)
    accepted = errors_px <= options.max_error_px
    return EpipolarFit(
        F=F_px,
        inliers=accepted,
        priors=prior_validity(points, f, threshold, sigma_from_inliers=True)[matches.rows],
        trials=trials,
        rms_px=math.sqrt(float(np.mean(errors_px[accepted] ** 2))),
        degeneracy=find_degeneracy(points, F, inliers, wrong, threshold, matches.centre / matches.unit_px),
    )
