"""Zero Curves as the product uses it: thesis (5.33) over all of K at once, then the matches themselves, then a verdict.

Beyond the thesis: the centre is sought together with the focal (cropped photos), fy/fx and a lens are freed where the
photos ask for it, every parameter comes with a standard deviation, and an answer that the pairs do not determine is not
given. The consensus of the pairs finds the camera from nothing; the adjustment of `refine` makes it exact.
"""

from dataclasses import replace

import numpy as np

from sfm_app.selfcal import peak
from sfm_app.selfcal.adjustment import Matches
from sfm_app.selfcal.answers import calibration_of, guessed
from sfm_app.selfcal.evidence import effective_count, spread_px
from sfm_app.selfcal.inputs import FloatArray, Pairs, prepare
from sfm_app.selfcal.joint import Consensus
from sfm_app.selfcal.lens import KAPPA, LOG_FOCAL
from sfm_app.selfcal.motion import open_focal
from sfm_app.selfcal.priors import LENS, USUAL_FOCAL, Usual
from sfm_app.selfcal.refine import Fit, refined, straight_fundamentals
from sfm_app.selfcal.uncertainty import covariance, key_pairs, spread_of
from sfm_app.settings import CalibrationSettings
from sfm_app.types import Calibration, CameraPairs

METHOD = "zero-curves"
MIN_PAIRS = 3
"""Each F gives two constraints; below three pairs nothing is left to contradict a wrong K."""
FEW_PAIRS = 3
"""So many pairs fit almost any centre: without their matches it is held where uncropped photos have it."""
UNCROPPED_SIGMA = 0.02
"""Standard deviation of the centre of such photos about the middle, in widths."""
ELSEWHERE = float(np.log(1.1))
"""A consensus on straightened photos that lies this far in log f from the adjusted camera is tried as a start."""


def calibrate(pairs: CameraPairs, options: CalibrationSettings, seed: int) -> Calibration:
    """Find the K that most pairs agree on, and the lens.

    Args:
        pairs: for their weights see `selfcal.pair_weights`. Without inliers nothing is known about a lens, and the
            standard deviations come from resampling the pairs.
        options: `centre_sigma` of the prior on the optical centre, and whether to look for a lens.
        seed: of that resampling.

    Returns:
        K with ``identifiable=True``, or a guess and the reason why the pairs do not determine K.

    Raises:
        ValueError: malformed input, see `selfcal.inputs.prepare`.
    """
    usable = _prepared(pairs)
    evidence = {"pairs": float(len(usable))}
    if len(usable) < MIN_PAIRS:
        return guessed(pairs.size, f"{len(usable)} usable pairs, {MIN_PAIRS} are needed", evidence)
    if pairs.inliers:
        return _from_matches(pairs, usable, options, evidence)
    return _from_fundamentals(pairs, usable, options, seed)


def _from_fundamentals(pairs: CameraPairs, usable: Pairs, options: CalibrationSettings, seed: int) -> Calibration:
    """The peak of the consensus, when the matrices are all that is known."""
    side = float(max(pairs.size))
    centre_sigma = options.centre_sigma if len(usable) > FEW_PAIRS else min(options.centre_sigma, UNCROPPED_SIGMA)
    consensus = Consensus(usable, centre_sigma * pairs.size[0] / side)
    answer = peak.found(consensus)
    scatter = answer.scatter(consensus, seed)
    log_focal_spread = answer.deviation(scatter[:, LOG_FOCAL])
    evidence = {"pairs": float(len(usable)), **answer.evidence(usable.weights), "log_focal_spread": log_focal_spread}
    reason = answer.contradicted(usable.weights) or peak.objection(answer.theta, log_focal_spread, _half(pairs.size))
    if reason:
        return guessed(pairs.size, reason, evidence)
    spread = spread_px(scatter, side, effective_count(answer.votes), len(answer.free))
    found = calibration_of(np.append(answer.theta, 0.0), pairs.size, METHOD)
    return replace(found, spread=spread, evidence=evidence)


def _from_matches(
    pairs: CameraPairs, usable: Pairs, options: CalibrationSettings, evidence: dict[str, float]
) -> Calibration:
    """The consensus finds where to begin; the matches say the rest; a consensus without the lens has the last word."""
    side = float(max(pairs.size))
    sigma = options.centre_sigma * pairs.size[0] / side
    hint = float(np.median(pairs.focal_hints_px)) / side if pairs.focal_hints_px else np.nan
    usual = Usual(np.ones(1), np.array([hint]), sigma, options.lens)
    matches, Fs = _in_sides(pairs, usable)
    answer = peak.found(Consensus(usable, sigma))
    plain = np.array([USUAL_FOCAL, 0.0, 0.0, 0.0])
    starts = [np.append(theta, 0.0)[None] for theta in (answer.theta, *answer.others[:1], plain)]
    fit = refined(matches, Fs, starts, usual)
    judged = usable
    if fit.free[0, LENS]:
        straight = _in_pixels(straight_fundamentals(fit), pairs)
        judged = _prepared(CameraPairs(straight, usable.weights, pairs.size))
        answer = peak.found(Consensus(judged, sigma))
        if abs(answer.theta[LOG_FOCAL] - fit.state.thetas[0, LOG_FOCAL]) > ELSEWHERE:
            again = np.append(answer.theta, fit.state.thetas[0, KAPPA])
            fit = refined(matches, Fs, [fit.state.thetas, again[None]], usual)
    theta, cov = fit.state.thetas[0], covariance(fit, np.ones(1))
    evidence |= {**answer.evidence(judged.weights), **_figures(fit, side, float(np.sqrt(cov[LOG_FOCAL, LOG_FOCAL])))}
    undecided = answer.contradicted(judged.weights)
    reason = (
        (undecided and (open_focal(fit) or undecided))
        or _split(theta, answer.theta)
        or peak.objection(theta, evidence["log_focal_spread"], _half(pairs.size))
    )
    if reason:
        return guessed(pairs.size, reason, evidence)
    found = calibration_of(theta, pairs.size, METHOD)
    photos = tuple(pairs.photos[k] for k in usable.kept) if pairs.photos else ()
    return replace(
        found,
        spread=spread_of(theta, cov, side),
        evidence=evidence,
        held=fit.names_held(0),
        key_pairs=key_pairs(fit, photos),
    )


def _prepared(pairs: CameraPairs) -> Pairs:
    width, height = pairs.size
    return prepare(pairs, unit_px=float(max(pairs.size)), origin_px=(width / 2, height / 2))


def _in_sides(pairs: CameraPairs, usable: Pairs) -> tuple[Matches, FloatArray]:
    """Inliers and F's of the usable pairs in longer sides about the middle."""
    side = float(max(pairs.size))
    middle = np.tile(np.array(pairs.size) / 2, 2)
    inliers = [(np.asarray(pairs.inliers[k], np.float64) - middle) / side for k in usable.kept]
    count = len(usable)
    photos = np.array([pairs.photos[k] for k in usable.kept]) if pairs.photos else np.arange(2 * count).reshape(-1, 2)
    return Matches(inliers, np.zeros((count, 2), np.int64), photos, side), usable.F


def _in_pixels(Fs: FloatArray, pairs: CameraPairs) -> FloatArray:
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


def _split(adjusted: FloatArray, agreed: FloatArray) -> str:
    """Why the matches and the consensus of their F's do not name one camera, or nothing."""
    ratio = float(np.exp(abs(adjusted[LOG_FOCAL] - agreed[LOG_FOCAL])))
    if ratio < 1.25:
        return ""
    return f"the pairs agree on one focal and their matches on another, {ratio:.1f} times away"


def _half(size: tuple[int, int]) -> tuple[float, float]:
    return 0.5 * size[0] / max(size), 0.5 * size[1] / max(size)
