"""From the best model of a search to the answer: a fit with its evidence, or a rejection with its reason.

Ours: the thesis ends with F*. The criteria come from thesis 4.2 (distances), 4.3 (the final fit) and Moisan and Stival
(2004).
"""

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike

from sfm_app.fundamental.a_contrario import MOST_FALSE_ALARMS, model_false_alarms, squared_mismatch_distances
from sfm_app.fundamental.degeneracy import DEGENERACY, dominant_homography, find_degeneracy, transfer_distance
from sfm_app.fundamental.leverage import prior_validity
from sfm_app.fundamental.loop import Recipe, run_loop
from sfm_app.fundamental.points import Matches, check_points, prepare
from sfm_app.fundamental.refits import choose_refit
from sfm_app.fundamental.scores import squared_distances
from sfm_app.geometry.epipolar import nearest_rank_two
from sfm_app.settings import EpipolarSettings
from sfm_app.types import EpipolarFit, Rejected
from sfm_app.types.arrays import FloatArray

ExternalSearch = Callable[[FloatArray, FloatArray, EpipolarSettings, int], tuple[ArrayLike, int] | None]
"""(x1, x2, options, seed) -> F and the number of samples drawn, or None; for `estimate_with`."""

# reasons of a rejection, in the order of the checks
TOO_FEW_MATCHES = "too few matches"
NO_MODEL = "no model found"
TOO_FEW_INLIERS = "too few inliers"
CHANCE = "inliers no better than chance"


def fit_by_recipe(
    x1: ArrayLike, x2: ArrayLike, options: EpipolarSettings, seed: int, recipe: Recipe
) -> EpipolarFit | Rejected:
    """Estimate F from matches x1, x2 (N, 2) in pixels, many of which may be wrong; ValueError as `check_points`."""
    first, second = check_points(x1, x2)
    matches = prepare(first, second, seed)
    if len(matches.points) < options.min_inliers:
        return Rejected(TOO_FEW_MATCHES)
    best = run_loop(matches, options, seed, recipe)
    if best is None:
        return Rejected(NO_MODEL)
    threshold = options.max_error_px / matches.unit_px
    F = choose_refit(options.refit, recipe.finish)(matches.points, best.F, threshold)
    if not np.isfinite(F).all():
        return Rejected(NO_MODEL)
    return _assess_model(first, second, matches, F, best.trials, options)


def estimate_with(
    search: ExternalSearch, x1: ArrayLike, x2: ArrayLike, options: EpipolarSettings, seed: int
) -> EpipolarFit | Rejected:
    """Run an external search and assess its F as for the built-in estimators; for plug-ins.

    The search gets the distinct matches, at least `options.min_inliers`, as contiguous (M, 2) pixels about the middle
    of each view, in an order that depends on the seed. It should not raise on data. Its F may have any scale, and is
    brought to rank 2. Inliers, priors, degeneracy and the test against chance are computed from this F.

    Raises:
        ValueError: the points are not valid (see `check_points`), or F is not (3, 3).
    """
    first, second = check_points(x1, x2)
    matches = prepare(first, second, seed)
    if len(matches.points) < options.min_inliers:
        return Rejected(TOO_FEW_MATCHES)
    px1, px2 = (np.ascontiguousarray(side) * matches.unit_px for side in np.hsplit(matches.points, 2))
    answer = search(px1, px2, options, seed)
    if answer is None:
        return Rejected(NO_MODEL)
    F, trials = answer
    return _assess_external(first, second, matches, _to_frame(F, matches.unit_px, np.zeros(4)), trials, options)


def assess_fundamental(x1: ArrayLike, x2: ArrayLike, F: ArrayLike, options: EpipolarSettings) -> EpipolarFit | Rejected:
    """Return the fit of a given F (3, 3), or the reason of its rejection; ValueError as `estimate_with`."""
    first, second = check_points(x1, x2)
    matches = prepare(first, second, seed=0)
    if len(matches.points) < options.min_inliers:
        return Rejected(TOO_FEW_MATCHES)
    return _assess_external(first, second, matches, _to_frame(F, matches.unit_px, matches.center), 1, options)


def count_matches_off_plane(x1: ArrayLike, x2: ArrayLike, F: ArrayLike, options: EpipolarSettings) -> int:
    """Count the distinct inliers of F off the plane that holds most of them; ValueError as `estimate_with`."""
    matches = prepare(*check_points(x1, x2), seed=0)
    threshold = options.max_error_px / matches.unit_px
    in_frame = _to_frame(F, matches.unit_px, matches.center)
    f = np.ascontiguousarray(in_frame / np.linalg.norm(in_frame))
    agreeing = np.asfortranarray(matches.points[squared_distances(matches.points, f.reshape(9)) <= threshold**2])
    H = dominant_homography(agreeing, f, threshold)
    return int(np.count_nonzero(transfer_distance(H, agreeing) > DEGENERACY.off * threshold))


def _to_frame(F: ArrayLike, unit_px: float, center: FloatArray) -> FloatArray:
    """Return F of pixels as F of `Matches.points`: the inverse of `Matches.to_pixels`."""
    pixels = np.asarray(F, dtype=np.float64)
    if pixels.shape != (3, 3):
        raise ValueError(f"F must have shape (3, 3), got {pixels.shape}")
    to1, to2 = (np.array([[unit_px, 0, x], [0, unit_px, y], [0, 0, 1]]) for x, y in (center[:2], center[2:]))
    with np.errstate(over="ignore", invalid="ignore"):  # an F that is not finite is rejected
        return np.asarray(to2.T @ pixels @ to1)


def _assess_external(
    x1: FloatArray, x2: FloatArray, matches: Matches, F: FloatArray, trials: int, options: EpipolarSettings
) -> EpipolarFit | Rejected:
    """Judge an F of any scale and rank; reject it if it is not finite or its rank is below 2."""
    largest = np.abs(F).max()
    if not (np.isfinite(largest) and largest > 0) or np.linalg.matrix_rank(F / largest) < 2:
        return Rejected(NO_MODEL)
    return _assess_model(x1, x2, matches, nearest_rank_two(F / largest), trials, options)


def _assess_model(
    x1: FloatArray, x2: FloatArray, matches: Matches, F: FloatArray, trials: int, options: EpipolarSettings
) -> EpipolarFit | Rejected:
    points, threshold = matches.points, options.max_error_px / matches.unit_px
    f = np.ascontiguousarray(F / np.linalg.norm(F)).reshape(9)
    squared = squared_distances(points, f)
    inliers = squared <= threshold * threshold
    if np.count_nonzero(inliers) < options.min_inliers:
        return Rejected(TOO_FEW_INLIERS)
    wrong = squared_mismatch_distances(points, f)
    if model_false_alarms(squared, wrong, threshold) > MOST_FALSE_ALARMS:
        return Rejected(CHANCE)
    F_px = matches.to_pixels(F)
    squared_px = squared_distances(np.asfortranarray(np.hstack([x1, x2])), F_px.reshape(9))
    accepted = squared_px <= options.max_error_px**2
    return EpipolarFit(
        F_px,
        inliers=accepted,
        priors=prior_validity(points, f, threshold, sigma_from_inliers=True)[matches.rows],
        trials=trials,
        rms_px=math.sqrt(float(squared_px[accepted].mean())),
        degeneracy=find_degeneracy(points, F, inliers, wrong, threshold, matches.center / matches.unit_px),
    )
