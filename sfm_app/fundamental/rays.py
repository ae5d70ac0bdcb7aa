"""LEV-RANSAC by rays, for photos with known lenses, whose epipolar lines are curved.

As `lev_ransac` (thesis 4.7); ours: samples of five (Nistér 2004), and distances by bearing vectors. `lines` are (N, 18)
matches as bearing vectors in pixels, see `camera.bearings`; `E` is of rays, q' E p = 0.
"""

import math
from collections.abc import Sequence

import numpy as np

from sfm_app.camera.bearings import bearings
from sfm_app.fundamental.a_contrario import MOST_FALSE_ALARMS, model_false_alarms, squared_mismatch_distances
from sfm_app.fundamental.degeneracy import DEGENERACY, find_degeneracy
from sfm_app.fundamental.estimate import CHANCE, NO_MODEL, TOO_FEW_INLIERS, TOO_FEW_MATCHES
from sfm_app.fundamental.lev_ransac import OPTIONS as LEV_RANSAC
from sfm_app.fundamental.leverage import cook_distances, mad_sigma, priors, studentized_residuals
from sfm_app.fundamental.samples import required_trials
from sfm_app.fundamental.solvers import RAY_SAMPLE_SIZE, solve_five_point
from sfm_app.geometry import epipolar
from sfm_app.settings import EpipolarSettings
from sfm_app.types import Calibration, RayFit, Rejected
from sfm_app.types.arrays import BoolArray, FloatArray, IndexArray


class OPTIONS:
    """Samples, scores and the test for a rotation; none was measured on its own. Chosen by hand."""

    batch: int = 32
    guided_share: float = 0.5
    """Share of the samples drawn by the priors."""
    least_trials: int = 128
    most_trials: int = 4096
    most_scored: int = 500
    """Matches that samples are scored on."""
    mismatches: int = 8
    """Shifts of the partners that measure chance."""
    rounds: int = 4
    """Fits that select inliers through lenses."""


def fit_lev_ransac_rays(lines: FloatArray, options: EpipolarSettings, seed: int) -> RayFit | Rejected:
    """Estimate E of a pair with known lenses from matches, many of which may be wrong."""
    _, first = np.unique(
        np.hstack([lines[:, epipolar.FIRST], lines[:, epipolar.SECOND]]).round(9), axis=0, return_index=True
    )
    rng = np.random.default_rng(seed)
    distinct = lines[rng.permutation(np.sort(first))]
    if len(distinct) < options.min_inliers:
        return Rejected(TOO_FEW_MATCHES)
    E, trials = _search(distinct, options, rng)
    if E is None:
        return Rejected(NO_MODEL)
    squared = epipolar.squared_distances(E[None], distinct)[0]
    inliers = squared <= options.max_error_px**2
    if np.count_nonzero(inliers) < options.min_inliers:
        return Rejected(TOO_FEW_INLIERS)
    if model_false_alarms(squared, _mismatch_distances(E, distinct), options.max_error_px) > MOST_FALSE_ALARMS:
        return Rejected(CHANCE)
    all_squared = epipolar.squared_distances(E[None], lines)[0]
    accepted = all_squared <= options.max_error_px**2
    rms, kind = math.sqrt(float(all_squared[accepted].mean())), _find_degeneracy(E, distinct[inliers], options)
    return RayFit(E, accepted, validity(lines, E, options.max_error_px), trials, rms, kind)


def select_inliers(
    points: Sequence[FloatArray], cameras: Sequence[Calibration], inliers: BoolArray, threshold: float
) -> tuple[BoolArray, str]:
    """Return (N,) the matches (N, 2), (N, 2) that agree with the F of rays of some of them; no focal is assumed.

    Also return their degeneracy without the bending of lenses, which hides planes, as of `find_degeneracy`.
    """
    lines = np.hstack([bearings(x, camera) for x, camera in zip(points, cameras, strict=True)])
    agreeing, slope = inliers, np.ones(len(lines))
    for _ in range(OPTIONS.rounds):
        F = epipolar.fit_rays(lines[:, epipolar.FIRST], lines[:, epipolar.SECOND], agreeing * slope**-2.0)
        agreeing, slope = epipolar.squared_distances(F[None], lines)[0] <= threshold**2, epipolar.gradients(F, lines)
    if np.count_nonzero(agreeing) < RAY_SAMPLE_SIZE:
        return agreeing, ""
    unit_px = float(np.mean([camera.focal_px for camera in cameras]))
    straight = np.asfortranarray(
        np.hstack([lines[:, ray][:, :2] / lines[:, ray][:, 2:] for ray in (epipolar.FIRST, epipolar.SECOND)])
    )
    wrong = squared_mismatch_distances(straight, np.ascontiguousarray(F).reshape(9))
    return agreeing, find_degeneracy(straight, F, agreeing, wrong, threshold / unit_px, np.zeros(4))


def validity(lines: FloatArray, E: FloatArray, threshold: float) -> FloatArray:
    """Return (N,) p(v_i) of every match from its influence on E (thesis 4.7.2 and 4.7.3)."""
    distances = np.abs(epipolar.signed_distances(E, lines))
    fitted = distances <= threshold
    if np.count_nonzero(fitted) <= 9:
        return np.ones(len(lines))
    rows = (lines[:, epipolar.SECOND][:, :, None] * lines[:, epipolar.FIRST][:, None, :]).reshape(
        -1, 9
    ) / epipolar.gradients(E, lines)[:, None]
    tangent = np.linalg.svd(E.reshape(1, 9))[2][1:].T
    within = rows @ tangent
    values, vectors = np.linalg.eigh(within[fitted].T @ within[fitted])
    forms = np.sum((within @ vectors) ** 2 / np.maximum(values, 1e-14 * values[-1]), axis=1)
    leverage = np.where(fitted, np.minimum(forms, 1.0), forms / (1.0 + forms))
    influence = cook_distances(studentized_residuals(distances, leverage, fitted), leverage)
    return np.asarray(priors(influence, mad_sigma(influence[fitted])), np.float64)


def _search(lines: FloatArray, options: EpipolarSettings, rng: np.random.Generator) -> tuple[FloatArray | None, int]:
    """Return the best E and the number of samples: Algorithm 1, a batch at a time."""
    scored, threshold = lines[: OPTIONS.most_scored], options.max_error_px
    best, lowest, coarse = None, math.inf, math.inf
    chances, trials, limit = np.ones(len(lines)), 0, min(options.max_trials, OPTIONS.most_trials)
    while trials < limit:
        samples = _draw(rng, chances if best is not None else None, len(lines))
        trials += OPTIONS.batch
        models = solve_five_point(lines[samples][..., epipolar.FIRST], lines[samples][..., epipolar.SECOND])
        if not len(models):
            continue
        costs = _costs(epipolar.squared_distances(models, scored), LEV_RANSAC.coarse * threshold).sum(axis=1)
        k = int(np.argmin(costs))
        if costs[k] >= coarse:
            continue
        coarse = float(costs[k])
        optimized = _optimize_locally(lines, models[k], threshold)
        cost = float(_costs(epipolar.squared_distances(optimized[None], lines), LEV_RANSAC.fine * threshold).sum())
        if cost < lowest:
            best, lowest, chances = optimized, cost, validity(lines, optimized, threshold)
            share = float(np.mean(epipolar.squared_distances(optimized[None], lines)[0] <= threshold**2))
            needed = max(OPTIONS.least_trials, required_trials(share**RAY_SAMPLE_SIZE, options.confidence))
            limit = math.ceil(min(options.max_trials, OPTIONS.most_trials, needed))
    return best, trials


def _draw(rng: np.random.Generator, chances: FloatArray | None, count: int) -> IndexArray:
    keys = rng.random((OPTIONS.batch, count))
    if chances is not None:  # the smallest of exponential times are a weighted sample without replacement
        guided = int(OPTIONS.guided_share * OPTIONS.batch)
        keys[:guided] = rng.exponential(size=(guided, count)) / np.maximum(chances, 1e-12)
    return np.argpartition(keys, RAY_SAMPLE_SIZE, axis=1)[:, :RAY_SAMPLE_SIZE]


def _optimize_locally(lines: FloatArray, E: FloatArray, threshold: float) -> FloatArray:
    """Refit to all matches with weights by the cost at the coarse scale, then at the fine one."""
    p, q = lines[:, epipolar.FIRST], lines[:, epipolar.SECOND]
    for scale, steps in zip((LEV_RANSAC.coarse, LEV_RANSAC.fine), LEV_RANSAC.local_steps, strict=True):
        for _ in range(steps):
            squared, slope = epipolar.squared_distances(E[None], lines)[0], epipolar.gradients(E, lines)
            weights = (1.0 + squared / (scale * threshold) ** 2) ** -2 * slope**-2
            E = epipolar.nearest_essential(epipolar.fit_rays(p, q, weights))
    return np.asarray(E / np.linalg.norm(E), np.float64)


def _costs(squared: FloatArray, scale: float) -> FloatArray:
    return np.asarray(squared / (squared + scale**2), np.float64)


def _mismatch_distances(E: FloatArray, lines: FloatArray) -> FloatArray:
    shifts = range(1, min(OPTIONS.mismatches, len(lines) - 1) + 1)
    wrong = [np.hstack([lines[:, :9], np.roll(lines[:, 9:], shift, axis=0)]) for shift in shifts]
    return np.concatenate([epipolar.squared_distances(E[None], one)[0] for one in wrong])


def _find_degeneracy(E: FloatArray, inliers: FloatArray, options: EpipolarSettings) -> str:
    """Return "rotation" if one of the two rotations of E explains the inliers alone."""
    within = DEGENERACY.off * options.max_error_px
    rotations = (epipolar.decompose_essential(E)[0][0], epipolar.decompose_essential(E)[2][0])
    shares = [float(np.mean(epipolar.rotation_residuals(inliers, R) <= within)) for R in rotations]
    return "rotation" if max(shares) >= DEGENERACY.clear_share else ""
