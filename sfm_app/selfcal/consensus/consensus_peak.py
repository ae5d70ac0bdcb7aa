"""The K that most pairs agree on: the highest peak of the joint consensus, and the evidence for and against it.

Thesis 5.8.4 extended from a plane to all of K; the evidence is ours.
"""

from dataclasses import dataclass

import numpy as np

from sfm_app.selfcal.consensus.consensus import CENTER_U, CENTER_V, LOG_ASPECT, LOG_FOCAL, Consensus
from sfm_app.selfcal.consensus.peak_evidence import (
    RIVAL_RATIO,
    best_rival,
    deviation,
    disagreement,
    effective_count,
    indecision,
    resample_peak,
    residual_sigma,
    votes,
)
from sfm_app.selfcal.consensus.peak_search import FOCAL_RANGE, SIGMAS, Peak, Profile, peaks, scan
from sfm_app.selfcal.inputs import FloatArray

SQUARE_PIXELS = (LOG_FOCAL, CENTER_U, CENTER_V)
"""Places in theta that are sought when pixels are square."""
ANY_PIXELS = (*SQUARE_PIXELS, LOG_ASPECT)
"""Places in theta that are sought when they need not be."""
LOG_ASPECTS = tuple(np.linspace(-0.6, 0.6, 9))
"""log fy/fx on the grid: 0.55 to 1.8. Chosen by hand; halved and doubled by `benchmarks.sensitivity`."""
ASPECT_GAIN = float(np.log(50))
"""Votes that freeing fy/fx must win: about one photo set in fifty has pixels that are not square. docs/algorithms.md,
Self-calibration, 1. Chosen by hand; halved and doubled by `benchmarks.sensitivity`."""
PERHAPS_ASPECT_GAIN = float(np.log(50 * 0.05))
"""Votes from which on square pixels are less than 95 % sure. Of 47 answers with square pixels on the photo sets and on
folders 0 to 170 of `python -m benchmarks.trouble`, one had more (1.55), and its pixels were not square."""
MAX_LOG_FOCAL_SPREAD = 0.1
"""Largest standard deviation of log f: a focal that is less certain starts bundle adjustment no better than a guess.
docs/algorithms.md, Self-calibration, 5. Chosen by hand; halved and doubled by `benchmarks.sensitivity`."""
IDENTIFIED_LOG_FOCAL_SPREAD = 0.02
"""Largest standard deviation of log f that counts as known: with 0.025 one focal of twenty is off by 5 %, which is too
much to be called identifiable. Between this and the limit above the answer is an estimate: a better start than a guess,
and no more. Of 109 cameras of seeds 0 to 180, 1000 to 1035 and 2000 to 2139 of `python -m benchmarks.trouble` four lie
between 0.02 and 0.03: off by 10, 7, 2 and 1 %."""
SAFE_LEAD_SHARE, SAFE_SUPPORT = 0.2, 0.8
"""Where a focal a quarter away loses less than the first share of the votes (walks to the side or on one plane), the
focal is poorly determined. Then pairs must win the second share of all votes: what misled the missing ones may have
biased the others. Of the same 109 cameras eight are short of both: off by 43, 10, 6, 4, 4, 1, 0.3 and 0.2 %; no other
of them whose deviation is below 0.02 is off by more than 2.5 %. docs/algorithms.md, Self-calibration, 5."""
IDENTIFIED_OF_MANY = 0.015
"""Largest such deviation where every photo has its own focal: the worst of many is further off than a single one.
docs/algorithms.md, Self-calibration, 6. Chosen by hand; halved and doubled by `benchmarks.sensitivity`."""
EDGE = 1.02
"""A focal within this factor of an end of the range counts as having run to that end. Chosen by hand; halved and
doubled by `benchmarks.sensitivity`."""


@dataclass(frozen=True, slots=True, eq=False)
class Answer:
    """A peak with everything that a verdict needs."""

    theta: FloatArray
    """(4,) log f, u, v, log a."""
    free: tuple[int, ...]
    """Places in theta that were sought."""
    sigma: float
    """Width of the consensus that fits the agreeing pairs."""
    lead: float
    """Votes by which it leads every other focal."""
    votes: FloatArray
    """(P,) votes of the pairs for it."""
    gain: float
    """Votes that freeing fy/fx wins."""
    others: tuple[FloatArray, ...]
    """(4,) each: lower peaks, highest first."""

    @property
    def doubt_of_pixels(self) -> str:
        """Why an answer with square pixels is only an estimate; empty where it is not."""
        doubtful = LOG_ASPECT not in self.free and self.gain >= PERHAPS_ASPECT_GAIN
        return "its pixels may not be square" if doubtful else ""

    def doubt_of_focal(self, weights: FloatArray) -> str:
        """Return why an answer to pairs of weights (P,) is an estimate despite a small deviation; empty for none."""
        mass = float(np.sum(self.votes))
        doubtful = self.lead < SAFE_LEAD_SHARE * mass and mass < SAFE_SUPPORT * float(np.sum(weights))
        return "many pairs fit other focals nearly as well, and some fit none" if doubtful else ""

    def evidence(self, weights: FloatArray) -> dict[str, float]:
        """Return figures for the report, by name."""
        mass = float(np.sum(self.votes))
        return {
            "support": mass / float(np.sum(weights)),
            "agreeing_pairs": effective_count(self.votes),
            "lead": self.lead,
            "lead_share": self.lead / mass if mass > 0 else 0.0,
            "sigma": self.sigma,
            "aspect_gain": self.gain,
        }

    def contradiction(self, weights: FloatArray) -> str:
        """Return why pairs of the given weights (P,) do not determine a camera; empty where they do."""
        return disagreement(self.votes, weights) or indecision(self.lead, self.votes)

    def resample(self, consensus: Consensus, seed: int) -> FloatArray:
        """Return (B, 4) the peak under resampled pairs, see `peak_evidence.resample_peak`.

        Args:
            consensus: of all pairs.
            seed: same seed, same result.
        """
        return resample_peak(consensus, self.theta, self.free, self.sigma, seed)

    def deviation(self, values: FloatArray) -> float:
        """Return the standard deviation of an entry of theta from its resampled `values` (B,)."""
        return deviation(values, effective_count(self.votes), len(self.free))


def find_peak(consensus: Consensus) -> Answer:
    """Find the highest peak with square pixels or, where the pairs clearly support it, with any aspect."""
    profile = scan(consensus, (0.0,))
    square = peaks(consensus, profile, SQUARE_PIXELS)
    free_profile = scan(consensus, LOG_ASPECTS)
    free = peaks(consensus, free_profile, ANY_PIXELS)
    # both use the width that fits the freer one: a wrong square answer would choose a lenient width
    sigmas = (residual_sigma(consensus, free[0].theta),)
    theta, value = consensus.climb(square[0].theta, SQUARE_PIXELS, sigmas)
    gain = max(consensus.climb(start, ANY_PIXELS, sigmas)[1] for start in (theta, free[0].theta)) - value
    if gain >= ASPECT_GAIN:
        return _examine(consensus, free, free_profile, ANY_PIXELS, gain)
    return _examine(consensus, square, profile, SQUARE_PIXELS, gain)


def _examine(consensus: Consensus, ends: list[Peak], profile: Profile, free: tuple[int, ...], gain: float) -> Answer:
    """Refine the highest peak with the width that fits its pairs, and collect the evidence for it."""
    best = ends[0]
    sigma = residual_sigma(consensus, best.theta)
    theta, _ = consensus.climb(best.theta, free, (sigma,))
    value = float(consensus.evaluate(theta[None, :], SIGMAS[-1])[0])
    far = [peak for peak in ends[1:] if abs(peak.theta[LOG_FOCAL] - theta[LOG_FOCAL]) > np.log(RIVAL_RATIO)]
    lead = value - max([best_rival(consensus, theta, free, SIGMAS, profile), *(peak.value for peak in far)])
    given = votes(consensus, theta, SIGMAS[-1])
    return Answer(theta, free, sigma, lead, given, gain, tuple(peak.theta for peak in far))


def vagueness(log_focal_spread: float, *, one_of_many: bool = False) -> str:
    """Return why an answer without objections is only an estimate; empty where it is identifiable.

    Args:
        log_focal_spread: standard deviation of log f.
        one_of_many: whether every photo has a focal of its own; a smaller spread is required then.
    """
    vague = log_focal_spread > (IDENTIFIED_OF_MANY if one_of_many else IDENTIFIED_LOG_FOCAL_SPREAD)
    return f"the focal is uncertain by {100 * log_focal_spread:.0f} %" if vague else ""


def objection(theta: FloatArray, log_focal_spread: float, half_size: tuple[float, float]) -> str:
    """Return why an answer that the pairs agree on is not trusted; empty where it is.

    Args:
        theta: log f, u, v, ... in longer sides from the middle.
        log_focal_spread: standard deviation of log f.
        half_size: half of the photo's width and height in longer sides.
    """
    focal, (low, high) = float(np.exp(theta[LOG_FOCAL])), FOCAL_RANGE
    if not low * EDGE < focal < high / EDGE:
        return f"the focal runs to the end of the range, {focal:.2f} longer sides"
    if np.any(np.abs(theta[CENTER_U : CENTER_V + 1]) > half_size):
        return "the optical center runs out of the photo"
    if log_focal_spread > MAX_LOG_FOCAL_SPREAD:
        return f"the focal is uncertain by {100 * log_focal_spread:.0f} %"
    return ""
