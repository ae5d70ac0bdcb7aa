"""Zero Curves as the product uses it: the consensus of thesis (5.33) over all of K at once, and a verdict on it.

Beyond the thesis: the centre is sought together with the focal (cropped photos), fy/fx is freed only where that is
clearly better (squeezed photos), and an answer that the pairs do not determine is not given.
"""

from dataclasses import dataclass

import numpy as np

from sfm_app.geometry.camera import camera_matrix
from sfm_app.selfcal.answers import guessed
from sfm_app.selfcal.evidence import (
    RIVAL_RATIO,
    best_rival,
    deviation,
    disagreement,
    effective_count,
    indecision,
    own_sigma,
    resampled,
    spread_px,
    votes,
)
from sfm_app.selfcal.inputs import FloatArray, prepare
from sfm_app.selfcal.joint import CENTRE_U, CENTRE_V, LOG_ASPECT, LOG_FOCAL, Consensus
from sfm_app.selfcal.search import FOCAL_RANGE, SIGMAS, Peak, Profile, peaks, scan
from sfm_app.settings import CalibrationSettings
from sfm_app.types import Calibration, CameraPairs

METHOD = "zero-curves"
SQUARE_PIXELS = (LOG_FOCAL, CENTRE_U, CENTRE_V)
ANY_PIXELS = (*SQUARE_PIXELS, LOG_ASPECT)
LOG_ASPECTS = tuple(np.linspace(-0.6, 0.6, 9))
"""log fy/fx on the grid: 0.55 to 1.8."""
ASPECT_GAIN = float(np.log(50))
"""Votes that freeing fy/fx must win: about one photo set in fifty has pixels that are not square."""
MIN_PAIRS = 3
"""Each F gives two constraints; below three pairs nothing is left to contradict a wrong K."""
FEW_PAIRS = 3
"""So many pairs fit almost any centre: it is then held where photos that nobody cropped have it."""
UNCROPPED_SIGMA = 0.02
"""Standard deviation of the centre of such photos about the middle, in widths."""
MAX_LOG_FOCAL_SPREAD = 0.1
"""Largest standard deviation of log f: a focal that is less certain starts bundle adjustment no better than a guess."""
EDGE = 1.02
"""A focal within this factor of an end of the range has run there."""


@dataclass(frozen=True, slots=True, eq=False)
class _Answer:
    """A peak with everything that the verdict needs."""

    theta: FloatArray
    free: tuple[int, ...]
    sigma: float
    lead: float
    votes: FloatArray
    resampled: FloatArray

    def deviation(self, index: int) -> float:
        """Standard deviation of one entry of theta."""
        return deviation(self.resampled[:, index], effective_count(self.votes), len(self.free))


def calibrate(pairs: CameraPairs, options: CalibrationSettings, seed: int) -> Calibration:
    """Find the K that most pairs agree on.

    Args:
        pairs: for their weights see `selfcal.pair_weights`.
        options: `centre_sigma` of the prior on the optical centre.
        seed: of the resampling behind `spread`.

    Returns:
        K with ``identifiable=True``, or a guess and the reason why the pairs do not determine K.

    Raises:
        ValueError: malformed input, see `selfcal.inputs.prepare`.
    """
    width, height = size = pairs.size
    unit_px = float(max(size))
    usable = prepare(pairs, unit_px=unit_px, origin_px=(width / 2, height / 2))
    evidence = {"pairs": float(len(usable))}
    if len(usable) < MIN_PAIRS:
        return guessed(size, f"{len(usable)} usable pairs, {MIN_PAIRS} are needed", evidence)
    centre_sigma = options.centre_sigma if len(usable) > FEW_PAIRS else min(options.centre_sigma, UNCROPPED_SIGMA)
    consensus = Consensus(usable, centre_sigma * width / unit_px)
    answer, gain = _found(consensus, seed)
    mass = float(np.sum(answer.votes))
    evidence |= {
        "support": mass / float(np.sum(usable.weights)),
        "agreeing_pairs": effective_count(answer.votes),
        "lead": answer.lead,
        "lead_share": answer.lead / mass if mass > 0 else 0.0,
        "sigma": answer.sigma,
        "aspect_gain": gain,
        "log_focal_spread": answer.deviation(LOG_FOCAL),
    }
    reason = (
        disagreement(answer.votes, usable.weights)
        or indecision(answer.lead, answer.votes)
        or _objection(answer, (0.5 * width / unit_px, 0.5 * height / unit_px))
    )
    if reason:
        return guessed(size, reason, evidence)
    f, a = np.exp(answer.theta[LOG_FOCAL]) * unit_px, np.exp(0.5 * answer.theta[LOG_ASPECT])
    centre = unit_px * answer.theta[CENTRE_U : CENTRE_V + 1] + np.array([width, height]) / 2
    K = camera_matrix(f / a, f * a, centre[0], centre[1])
    spread = spread_px(answer.resampled, unit_px, effective_count(answer.votes), len(answer.free))
    return Calibration(K, width, height, METHOD, identifiable=True, spread=spread, evidence=evidence)


def _found(consensus: Consensus, seed: int) -> tuple[_Answer, float]:
    """The answer with square pixels, or, where the pairs clearly ask for it, with any; and what freeing fy/fx gains."""
    profile = scan(consensus, (0.0,))
    square = peaks(consensus, profile, SQUARE_PIXELS)
    free_profile = scan(consensus, LOG_ASPECTS)
    free = peaks(consensus, free_profile, ANY_PIXELS)
    # both are measured with the width that suits the freer one, or a wrong square answer would choose a lenient width
    sigmas = (own_sigma(consensus, free[0].theta),)
    theta, value = consensus.climb(square[0].theta, SQUARE_PIXELS, sigmas)
    gain = max(consensus.climb(start, ANY_PIXELS, sigmas)[1] for start in (theta, free[0].theta)) - value
    if gain >= ASPECT_GAIN:
        return _examined(consensus, free, free_profile, ANY_PIXELS, seed), gain
    return _examined(consensus, square, profile, SQUARE_PIXELS, seed), gain


def _examined(consensus: Consensus, found: list[Peak], profile: Profile, free: tuple[int, ...], seed: int) -> _Answer:
    """Refine the highest peak to the width that its own pairs ask for, and collect what speaks for it."""
    best = found[0]
    sigma = own_sigma(consensus, best.theta)
    theta, _ = consensus.climb(best.theta, free, (sigma,))
    value = float(consensus.at(theta[None, :], SIGMAS[-1])[0])
    far = [peak.value for peak in found[1:] if abs(peak.theta[LOG_FOCAL] - theta[LOG_FOCAL]) > np.log(RIVAL_RATIO)]
    lead = value - max([best_rival(consensus, theta, free, SIGMAS, profile), *far])
    return _Answer(
        theta, free, sigma, lead, votes(consensus, theta, SIGMAS[-1]), resampled(consensus, theta, free, sigma, seed)
    )


def _objection(answer: _Answer, half_size: tuple[float, float]) -> str:
    """Why an answer that the pairs agree on is not to be trusted, or nothing."""
    focal, (low, high) = float(np.exp(answer.theta[LOG_FOCAL])), FOCAL_RANGE
    if not low * EDGE < focal < high / EDGE:
        return f"the focal runs to the end of the range, {focal:.2f} longer sides"
    if np.any(np.abs(answer.theta[CENTRE_U : CENTRE_V + 1]) > half_size):
        return "the optical centre runs out of the photo"
    uncertainty = answer.deviation(LOG_FOCAL)
    if uncertainty > MAX_LOG_FOCAL_SPREAD:
        return f"the focal is uncertain by {100 * uncertainty:.0f} %"
    return ""
