"""Zero Curves as the program uses it: thesis (5.33) over all of K at once, then the matches themselves, then a verdict.

Beyond the thesis: the center is sought together with the focal (cropped photos), fy/fx and a lens are freed where the
evidence supports it, every parameter has a standard deviation, and K is refused where the pairs do not determine it.
The consensus of the pairs finds the camera without a start; the adjustment of `calibrate_pairs` makes it exact.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from sfm_app.selfcal import consensus as consensus_peak
from sfm_app.selfcal.adjustment import Matches
from sfm_app.selfcal.calibrate_pairs import (
    Fit,
    camera_uncertainty,
    covariance,
    critical_motion,
    extend_to_all_pairs,
    fit_cameras,
    key_pairs,
    undistorted_fundamentals,
)
from sfm_app.selfcal.consensus import Consensus, effective_count, spread_px
from sfm_app.selfcal.pairs import (
    KAPPA,
    LOG_FOCAL,
    Pairs,
    calibration_from_parameters,
    downgrade_to_estimate,
    guess_calibration,
    prepare,
)
from sfm_app.selfcal.priors import LENS, USUAL_FOCAL, CameraPriors
from sfm_app.settings import CalibrationSettings
from sfm_app.types import Calibration, CameraPairs
from sfm_app.types.arrays import FloatArray

METHOD = "zero-curves"
MIN_PAIRS = 3
"""Each F gives two constraints; below three pairs nothing is left to contradict a wrong K. Counted, by definition of
the constraint (thesis 5.2.4)."""
FEW_PAIRS = 3
"""Pairs up to which almost any center fits: without their matches it is held where uncropped photos have it. Chosen by
hand; halved and doubled by `benchmarks.sensitivity`."""
UNCROPPED_SIGMA = 0.02
"""Standard deviation of the center of uncropped photos from the middle, in widths. Chosen by hand; halved and doubled
by `benchmarks.sensitivity`."""
VOTES_SIGMA, LEAST_KEPT_SHARE = 0.01, 0.8
"""Width of votes, and share of the votes for the peak of the consensus that the adjusted camera must keep: with less,
it follows matches that most pairs contradict. On fourteen sets and variants right adjustments keep 0.97 to 1, the one
that many wrong F's pulled away (fox50) 0.35; without that set the bound would be the same. Which sets:
benchmarks/corpus/tuning_sets.py."""
ENOUGH_PAIRS = 6.0
"""Effective pairs that must agree on the peak to contradict the camera: twelve constraints on five parameters of a
camera. With three pairs (merton1) the peak's center is anywhere. docs/algorithms.md, Self-calibration, 2. Chosen by
hand; halved and doubled by `benchmarks.sensitivity`."""
AGREEING_RATIO = 0.1
"""A contradicted camera is adjusted again, only to pairs with r below this at the peak; on the same sets 0.03 and 0.05
move no focal by more than 0.1 %. Chosen on those sets, benchmarks/corpus/tuning_sets.py."""
MOST_ADJUSTED = 800
"""Pairs to whose matches a camera is adjusted; all pairs vote for it and judge it. Chosen by hand."""
ANOTHER_FOCAL = 1.25
"""Factor by which focals of the consensus and of the matches may differ. docs/algorithms.md, Self-calibration, 5.
Chosen by hand; halved and doubled by `benchmarks.sensitivity`."""
RESTART_DISTANCE = float(np.log(1.1))
"""A consensus of undistorted pairs that lies this far in log f from the adjusted camera is tried as a start. Chosen by
hand; halved and doubled by `benchmarks.sensitivity`."""


def calibrate(pairs: CameraPairs, options: CalibrationSettings, seed: int) -> Calibration:
    """Find the K that most pairs agree on, and the lens.

    Args:
        pairs: for their weights see `selfcal.pair_weights`. Without inliers nothing is known about a lens, and the
            standard deviations come from resampling the pairs.
        options: `center_sigma` of the prior on the optical center, and whether to look for a lens.
        seed: of that resampling.

    Returns:
        K with ``identifiable=True``, or a guess and the reason why the pairs do not determine K.

    Raises:
        ValueError: malformed input, see `selfcal.inputs.prepare`.
    """
    usable = _prepare(pairs)
    evidence = {"pairs": float(len(usable))}
    if len(usable) < MIN_PAIRS:
        return guess_calibration(pairs.size, f"{len(usable)} usable pairs, {MIN_PAIRS} are needed", evidence)
    if pairs.inliers:
        return _calibrate_from_matches(pairs, usable, options, evidence)
    return _calibrate_from_fundamentals(pairs, usable, options, seed)


def _calibrate_from_fundamentals(
    pairs: CameraPairs, usable: Pairs, options: CalibrationSettings, seed: int
) -> Calibration:
    """Find the camera from the matrices alone: the peak of the consensus."""
    side = float(max(pairs.size))
    center_sigma = options.center_sigma if len(usable) > FEW_PAIRS else min(options.center_sigma, UNCROPPED_SIGMA)
    consensus = Consensus(usable, center_sigma * pairs.size[0] / side)
    answer = consensus_peak.find_peak(consensus)
    scatter = answer.resample(consensus, seed)
    log_focal_spread = answer.deviation(scatter[:, LOG_FOCAL])
    evidence = {"pairs": float(len(usable)), **answer.evidence(usable.weights), "log_focal_spread": log_focal_spread}
    reason = answer.contradiction(usable.weights) or consensus_peak.objection(
        answer.theta, log_focal_spread, _half_size(pairs.size)
    )
    if reason:
        return guess_calibration(pairs.size, reason, evidence)
    spread = spread_px(scatter, side, effective_count(answer.votes), len(answer.free))
    found = calibration_from_parameters(np.append(answer.theta, 0.0), pairs.size, METHOD)
    doubt = consensus_peak.vagueness(log_focal_spread) or answer.doubt_of_focal(usable.weights)
    doubt = doubt or answer.doubt_of_pixels
    return downgrade_to_estimate(replace(found, spread=spread, evidence=evidence), doubt)


def _calibrate_from_matches(
    pairs: CameraPairs, usable: Pairs, options: CalibrationSettings, evidence: dict[str, float]
) -> Calibration:
    """Adjust the camera to the matches, starting from the consensus.

    A consensus of undistorted pairs then confirms or contradicts it.
    """
    side = float(max(pairs.size))
    sigma = options.center_sigma * pairs.size[0] / side
    hint = float(np.median(pairs.focal_hints_px)) / side if pairs.focal_hints_px else np.nan
    priors = CameraPriors(np.ones(1), np.array([hint]), sigma, options.lens)
    adjusted = _adjust(pairs, usable, priors)
    if adjusted.is_contradicted:
        again = _adjust(pairs, usable, priors, adjusted)
        adjusted = max(adjusted, again, key=lambda one: one.kept_share)
    fit, answer, judged = adjusted.fit, adjusted.answer, adjusted.consensus.pairs
    theta, cov = fit.state.thetas[0], covariance(fit, np.ones(1), resampled=True)
    evidence |= {**answer.evidence(judged.weights), **_figures(fit, side, float(np.sqrt(cov[LOG_FOCAL, LOG_FOCAL])))}
    evidence["votes_kept"] = adjusted.kept_share
    undecided, split = answer.contradiction(judged.weights), _contradiction(adjusted)
    believed, spread = (answer.theta, 0.0) if split else (theta, evidence["log_focal_spread"])
    reason = (undecided and (critical_motion(fit) or undecided)) or consensus_peak.objection(
        believed, spread, _half_size(pairs.size)
    )
    if reason:
        return guess_calibration(pairs.size, reason, evidence)
    if split:
        agreed = calibration_from_parameters(np.append(answer.theta, theta[KAPPA]), pairs.size, METHOD)
        return replace(downgrade_to_estimate(agreed, split), evidence=evidence)
    found = calibration_from_parameters(theta, pairs.size, METHOD)
    photos = tuple(pairs.photos[k] for k in usable.kept[adjusted.used_pairs]) if pairs.photos else ()
    found = replace(
        found,
        **camera_uncertainty(theta, cov, side)._asdict(),
        evidence=evidence,
        held=fit.held_names(0),
        key_pairs=key_pairs(fit, photos),
    )
    doubt = answer.doubt_of_focal(judged.weights) or (answer.doubt_of_pixels if "aspect" in found.held else "")
    return downgrade_to_estimate(found, consensus_peak.vagueness(evidence["log_focal_spread"]) or doubt)


@dataclass(frozen=True, slots=True, eq=False)
class _Adjustment:
    """A camera adjusted to matches, and the consensus of all pairs to check it."""

    fit: Fit
    used_pairs: NDArray[np.int64]
    """Which of the usable pairs it was adjusted to."""
    consensus: Consensus
    """Of all usable pairs, undistorted."""
    answer: consensus_peak.Answer
    """Its peak."""

    @property
    def kept_share(self) -> float:
        """Votes for the camera over those for the peak."""
        thetas = np.array([self.fit.state.thetas[0, :KAPPA], self.answer.theta])
        at_fit, at_peak = self.consensus.evaluate(thetas, VOTES_SIGMA)
        return float(at_fit / at_peak) if at_peak > 0 else 0.0

    @property
    def is_contradicted(self) -> bool:
        """Whether enough pairs agree on another camera to reject this one: few pairs fit almost any center."""
        enough = min(effective_count(self.answer.votes), float(len(self.agreeing_pairs)))
        return self.kept_share < LEAST_KEPT_SHARE and enough >= ENOUGH_PAIRS

    @property
    def agreeing_pairs(self) -> NDArray[np.int64]:
        """Usable pairs that come near the peak."""
        return np.flatnonzero(self.consensus.ratios(self.answer.theta) < AGREEING_RATIO)


def _adjust(pairs: CameraPairs, usable: Pairs, priors: CameraPriors, before: _Adjustment | None = None) -> _Adjustment:
    """Adjust the camera to the matches of all pairs, or only of those that agree on the peak of `before`."""
    matches, Fs = _convert_to_sides(pairs, usable)
    if before is None:
        first, listened = consensus_peak.find_peak(Consensus(usable, priors.center_sigma)), _rows_to_adjust(len(usable))
        plain = np.array([USUAL_FOCAL, 0.0, 0.0, 0.0])
        starts = [np.append(theta, 0.0)[None] for theta in (first.theta, *first.others[:1], plain)]
    else:
        first, listened = before.answer, before.agreeing_pairs[_rows_to_adjust(len(before.agreeing_pairs))]
        starts = [np.append(first.theta, before.fit.state.thetas[0, KAPPA])[None]]
    fit = fit_cameras(matches.select(listened), Fs[listened], starts, priors)
    consensus, answer = Consensus(usable, priors.center_sigma), first
    if fit.free[0, LENS]:
        straight = _convert_to_pixels(undistorted_fundamentals(extend_to_all_pairs(fit, matches, Fs)), pairs)
        consensus = Consensus(_prepare(CameraPairs(straight, usable.weights, pairs.size)), priors.center_sigma)
    if fit.free[0, LENS] or (before is not None and before.fit.free[0, LENS]):
        answer = consensus_peak.find_peak(consensus)
    if abs(answer.theta[LOG_FOCAL] - fit.state.thetas[0, LOG_FOCAL]) > RESTART_DISTANCE:
        again = np.append(answer.theta, fit.state.thetas[0, KAPPA])
        fit = fit_cameras(matches.select(listened), Fs[listened], [fit.state.thetas, again[None]], priors)
    return _Adjustment(fit, listened, consensus, answer)


def _rows_to_adjust(count: int) -> NDArray[np.int64]:
    """Return the pairs to whose matches a camera is adjusted: all, or evenly chosen ones."""
    return np.unique(np.linspace(0, count - 1, min(count, MOST_ADJUSTED)).astype(np.int64))


def _prepare(pairs: CameraPairs) -> Pairs:
    width, height = pairs.size
    return prepare(pairs, unit_px=float(max(pairs.size)), origin_px=(width / 2, height / 2))


def _convert_to_sides(pairs: CameraPairs, usable: Pairs) -> tuple[Matches, FloatArray]:
    """Return the inliers and F's of the usable pairs in longer sides from the middle."""
    side = float(max(pairs.size))
    middle = np.tile(np.array(pairs.size) / 2, 2)
    inliers = [(np.asarray(pairs.inliers[k], np.float64) - middle) / side for k in usable.kept]
    count = len(usable)
    photos = np.array([pairs.photos[k] for k in usable.kept]) if pairs.photos else np.arange(2 * count).reshape(-1, 2)
    return Matches(inliers, np.zeros((count, 2), np.int64), photos, side), usable.F


def _convert_to_pixels(Fs: FloatArray, pairs: CameraPairs) -> FloatArray:
    side = float(max(pairs.size))
    to_sides = np.array([[1 / side, 0, -pairs.size[0] / 2 / side], [0, 1 / side, -pairs.size[1] / 2 / side], [0, 0, 1]])
    return np.asarray(to_sides.T @ Fs @ to_sides, np.float64)


def _figures(fit: Fit, side: float, log_focal_spread: float) -> dict[str, float]:
    return {
        "log_focal_spread": log_focal_spread,
        "noise_px": fit.state.sigma * side,
        "conflict": fit.state.scale,
        "weight": float(np.sum(fit.state.weights)),
    }


def _contradiction(adjusted: _Adjustment) -> str:
    """Return why the matches and the consensus of their F's disagree on the camera; empty where they agree."""
    ratio = float(np.exp(abs(adjusted.fit.state.thetas[0, LOG_FOCAL] - adjusted.answer.theta[LOG_FOCAL])))
    if ratio >= ANOTHER_FOCAL:
        return f"the pairs agree on one focal and their matches on another, {ratio:.1f} times away"
    if adjusted.is_contradicted:
        kept = 100 * adjusted.kept_share
        return f"the pairs agree on one camera, their matches on another, which keeps {kept:.0f} % of its votes"
    return ""


def _half_size(size: tuple[int, int]) -> tuple[float, float]:
    return 0.5 * size[0] / max(size), 0.5 * size[1] / max(size)
