"""Zero Curves as the program uses it: thesis (5.33) over all of K at once, then the matches themselves, then a verdict.

Beyond the thesis: the center is estimated together with the focal (cropped photos), fy/fx and a lens are freed where
the evidence supports it, every parameter has a standard deviation, and K is rejected where the pairs do not determine
it. The consensus of the pairs finds the camera without a start; the adjustment of `calibrate_pairs` makes it exact.
"""

from dataclasses import dataclass, replace

import numpy as np

from sfm_app.camera.models import CENTER, FOCAL, LENS
from sfm_app.selfcal import calibrate_pairs
from sfm_app.selfcal.adjustment import Matches
from sfm_app.selfcal.consensus import (
    CONSENSUS,
    Consensus,
    ConsensusPeak,
    deviation,
    effective_count,
    find_peak,
    rejection_reason,
    resample_peak,
    spread_px,
    uncertainty_reason,
)
from sfm_app.selfcal.pairs import (
    KAPPA,
    LEAST_PAIRS,
    LOG_FOCAL,
    Pairs,
    calibration_from_parameters,
    downgrade_to_estimate,
    guess_calibration,
    prepare,
    sides_from_pixels,
)
from sfm_app.selfcal.priors import PRIORS, CameraPriors, claim_rows
from sfm_app.settings import CalibrationSettings
from sfm_app.types import Calibration, CameraPairs, CameraPrior
from sfm_app.types.arrays import BoolArray, FloatArray, IndexArray

METHOD = "zero-curves"


@dataclass(frozen=True, slots=True)
class ZeroCurveOptions:
    """Choice of pairs, and agreement of consensus and matches. Sections of docs/algorithms/zero-curves.md."""

    uncropped_sigma: float = 0.02
    """Standard deviation of the center of uncropped photos from the middle, in widths; by hand."""
    votes_sigma: float = 0.01
    """Width of the votes that compare the adjusted camera with the peak, in r; by hand."""
    least_vote_share: float = 0.8
    """Least votes for the adjusted camera over those for the peak: below it the camera follows matches that most pairs
    contradict. Right ones have 0.97 to 1, fox50 0.35. Chosen on sets of benchmarks/corpus/tuning_sets.py."""
    enough_pairs: float = 6.0
    """Effective pairs that must agree on the peak to contradict the camera: twelve constraints on five parameters.
    Section 2; by hand."""
    agreeing_ratio: float = 0.1
    """A contradicted camera is adjusted again, only to pairs with r below this at the peak. Chosen on the same sets."""
    most_adjusted: int = 800
    """Pairs to whose matches a camera is adjusted; all pairs vote for it and judge it; by hand."""


ZERO_CURVES = ZeroCurveOptions()


def calibrate(pairs: CameraPairs, options: CalibrationSettings, seed: int) -> Calibration:
    """Find the K that most pairs agree on, and the lens; a guess where the pairs do not determine K."""
    usable = _prepare(pairs)
    evidence = {"pairs": float(len(usable))}
    if len(usable) < LEAST_PAIRS:
        return guess_calibration(pairs.size, f"{len(usable)} usable pairs, {LEAST_PAIRS} are needed", evidence)
    if pairs.inliers:
        return _calibrate_from_matches(pairs, usable, options, evidence)
    return _calibrate_from_fundamentals(pairs, usable, options, seed)


def _calibrate_from_fundamentals(
    pairs: CameraPairs, usable: Pairs, options: CalibrationSettings, seed: int
) -> Calibration:
    """Find the camera from the matrices alone: the peak of the consensus."""
    side = float(max(pairs.size))
    # almost any center fits so few pairs: it stays that of uncropped photos
    uncropped = len(usable) == LEAST_PAIRS
    center_sigma = min(options.center_sigma, ZERO_CURVES.uncropped_sigma) if uncropped else options.center_sigma
    consensus = Consensus(usable, center_sigma * pairs.size[0] / side)
    peak = find_peak(consensus)
    resampled = resample_peak(consensus, peak.theta, peak.free, peak.sigma, seed)
    count, unknowns = effective_count(peak.votes), len(peak.free)
    log_focal_spread = deviation(resampled[:, LOG_FOCAL], count, unknowns)
    evidence = {"pairs": float(len(usable)), **peak.evidence(usable.weights), "log_focal_spread": log_focal_spread}
    reason = peak.undetermined_reason(usable.weights) or rejection_reason(peak.theta, log_focal_spread, pairs.size)
    if reason:
        return guess_calibration(pairs.size, reason, evidence)
    spread = spread_px(resampled, side, count, unknowns)
    calibration = calibration_from_parameters(np.append(peak.theta, 0.0), pairs.size, METHOD)
    doubt = uncertainty_reason(log_focal_spread) or peak.rival_reason(usable.weights) or peak.aspect_reason
    return downgrade_to_estimate(replace(calibration, spread=spread, evidence=evidence), doubt)


def _calibrate_from_matches(
    pairs: CameraPairs, usable: Pairs, options: CalibrationSettings, evidence: dict[str, float]
) -> Calibration:
    """Adjust the camera to the matches from the consensus; a consensus of undistorted pairs then judges it."""
    side = float(max(pairs.size))
    sigma = options.center_sigma * pairs.size[0] / side
    priors = CameraPriors(np.ones(1), claim_rows([pairs.prior], [pairs.size], side), sigma, options.lens)
    adjusted = _adjust(pairs, usable, priors)
    rest = _unrejected(pairs.prior, adjusted.fit.free[0])
    if rest != pairs.prior:  # what is rejected is no evidence, and may not cost any
        return _calibrate_from_matches(replace(pairs, prior=rest), usable, options, evidence)
    if adjusted.is_contradicted:
        adjusted = max(adjusted, _adjust(pairs, usable, priors, adjusted), key=lambda one: one.vote_share)
    fit, peak, weights = adjusted.fit, adjusted.peak, adjusted.consensus.pairs.weights
    theta, cov = fit.state.thetas[0], calibrate_pairs.covariance(fit, np.ones(1), resampled=True)
    evidence |= peak.evidence(weights) | {
        "log_focal_spread": float(np.sqrt(cov[LOG_FOCAL, LOG_FOCAL])),
        "noise_px": fit.state.sigma * side,
        "conflict": fit.state.scale,
        "weight": float(np.sum(fit.state.weights)),
        "votes_kept": adjusted.vote_share,
    }
    undetermined, disagreement = peak.undetermined_reason(weights), _disagreement_reason(adjusted)
    answer, spread = (peak.theta, 0.0) if disagreement else (theta, evidence["log_focal_spread"])
    reason = undetermined and (calibrate_pairs.critical_motion(fit) or undetermined)
    reason = reason or rejection_reason(answer, spread, pairs.size)
    if reason:
        return guess_calibration(pairs.size, reason, evidence)
    if disagreement:
        calibration = calibration_from_parameters(np.append(peak.theta, theta[KAPPA]), pairs.size, METHOD)
        return replace(downgrade_to_estimate(calibration, disagreement), evidence=evidence)
    photos = tuple(pairs.photos[k] for k in usable.indices[adjusted.rows]) if pairs.photos else ()
    calibration = replace(
        calibration_from_parameters(theta, pairs.size, METHOD),
        **calibrate_pairs.camera_uncertainty(theta, cov, side),
        evidence=evidence,
        held=fit.held_names(0),
        key_pairs=calibrate_pairs.key_pairs(fit, photos),
    )
    doubt = uncertainty_reason(spread) or peak.rival_reason(weights)
    doubt = doubt or (peak.aspect_reason if "aspect" in calibration.held else "")
    return downgrade_to_estimate(calibration, doubt)


def _unrejected(prior: CameraPrior | None, free: BoolArray) -> CameraPrior | None:
    """Return a claim without the parts (4,) that the pairs have freed; None where they have freed its focal."""
    if prior is None or free[FOCAL]:
        return None
    center, k1 = None if free[CENTER] else prior.center_px, None if free[LENS] else prior.k1
    return replace(prior, center_px=center, k1=k1)


@dataclass(frozen=True, slots=True, eq=False)
class _Adjustment:
    """A camera adjusted to matches, and the consensus of all pairs to check it."""

    fit: calibrate_pairs.Fit
    rows: IndexArray
    """The usable pairs that it was adjusted to."""
    consensus: Consensus
    """Of all usable pairs, undistorted."""
    peak: ConsensusPeak

    @property
    def vote_share(self) -> float:
        thetas = np.array([self.fit.state.thetas[0, :KAPPA], self.peak.theta])
        at_fit, at_peak = self.consensus.evaluate(thetas, ZERO_CURVES.votes_sigma)
        return float(at_fit / at_peak) if at_peak > 0 else 0.0

    @property
    def is_contradicted(self) -> bool:
        """Whether enough pairs agree on another camera to reject this one: few pairs fit almost any center."""
        enough = min(effective_count(self.peak.votes), float(len(self.agreeing_pairs)))
        return self.vote_share < ZERO_CURVES.least_vote_share and enough >= ZERO_CURVES.enough_pairs

    @property
    def agreeing_pairs(self) -> IndexArray:
        return np.flatnonzero(self.consensus.ratios(self.peak.theta) < ZERO_CURVES.agreeing_ratio)


def _adjust(pairs: CameraPairs, usable: Pairs, priors: CameraPriors, before: _Adjustment | None = None) -> _Adjustment:
    """Adjust the camera to the matches of all pairs, or only of those that agree on the peak of `before`."""
    matches, Fs = _convert_to_sides(pairs, usable)
    if before is None:
        first, rows = find_peak(Consensus(usable, priors.center_sigma)), _subsample(len(usable))
        plain = np.array([PRIORS.usual_log_focal, 0.0, 0.0, 0.0])
        claimed = [np.append(priors.claims[0, 0, :1], plain[1:])] if priors.claims_focal[0] else []
        starts = [np.append(theta, 0.0)[None] for theta in (first.theta, *first.rivals[:1], plain, *claimed)]
    else:
        first, rows = before.peak, before.agreeing_pairs[_subsample(len(before.agreeing_pairs))]
        starts = [np.append(first.theta, before.fit.state.thetas[0, KAPPA])[None]]
    fit = calibrate_pairs.fit_cameras(matches.select(rows), Fs[rows], starts, priors)
    consensus, peak = Consensus(usable, priors.center_sigma), first
    if fit.free[0, LENS]:
        to_sides = sides_from_pixels(pairs.size)
        straight = (
            to_sides.T
            @ calibrate_pairs.undistorted_fundamentals(calibrate_pairs.extend_to_all_pairs(fit, matches, Fs))
            @ to_sides
        )
        consensus = Consensus(_prepare(CameraPairs(straight, usable.weights, pairs.size)), priors.center_sigma)
    if fit.free[0, LENS] or (before is not None and before.fit.free[0, LENS]):
        peak = find_peak(consensus)
    if abs(peak.theta[LOG_FOCAL] - fit.state.thetas[0, LOG_FOCAL]) > np.log(CONSENSUS.rival_ratio):
        restart = np.append(peak.theta, fit.state.thetas[0, KAPPA])
        fit = calibrate_pairs.fit_cameras(matches.select(rows), Fs[rows], [fit.state.thetas, restart[None]], priors)
    return _Adjustment(fit, rows, consensus, peak)


def _subsample(count: int) -> IndexArray:
    """Return the pairs to whose matches a camera is adjusted: all, or evenly chosen ones."""
    return np.unique(np.linspace(0, count - 1, min(count, ZERO_CURVES.most_adjusted)).astype(np.int64))


def _prepare(pairs: CameraPairs) -> Pairs:
    width, height = pairs.size
    return prepare(pairs, unit_px=float(max(pairs.size)), origin_px=(width / 2, height / 2))


def _convert_to_sides(pairs: CameraPairs, usable: Pairs) -> tuple[Matches, FloatArray]:
    """Return the inliers and F's of the usable pairs in longer sides from the middle."""
    side = float(max(pairs.size))
    middle = np.tile(np.array(pairs.size) / 2, 2)
    inliers = [(np.asarray(pairs.inliers[k], np.float64) - middle) / side for k in usable.indices]
    count = len(usable)
    photos = (
        np.array([pairs.photos[k] for k in usable.indices]) if pairs.photos else np.arange(2 * count).reshape(-1, 2)
    )
    return Matches(inliers, np.zeros((count, 2), np.int64), photos, side), usable.F


def _disagreement_reason(adjusted: _Adjustment) -> str:
    """Return why the matches and the consensus of their F's disagree on the camera; empty where they agree."""
    ratio = float(np.exp(abs(adjusted.fit.state.thetas[0, LOG_FOCAL] - adjusted.peak.theta[LOG_FOCAL])))
    if ratio >= CONSENSUS.rival_ratio:
        return f"the matches give another focal than the fundamental matrices, by a factor of {ratio:.1f}"
    if adjusted.is_contradicted:
        percent = 100 * adjusted.vote_share
        return f"the matches give another camera than the fundamental matrices; it keeps {percent:.0f} % of the votes"
    return ""
