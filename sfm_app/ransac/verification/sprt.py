"""Wald's sequential probability ratio test of hypotheses (Matas and Chum 2005, Chum and Matas 2008; thesis 4.9).

Matches are inliers of a good model with probability epsilon, of a bad one with probability delta. The likelihood ratio
of "bad" to "good" is multiplied up match by match; when it exceeds A the model is rejected, which happens to a good one
with a probability of at most 1/A.
"""

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from sfm_app.ransac.sampling.stopping import trials_needed
from sfm_app.ransac.verification.pretests import PreTest

IntArray = NDArray[np.int64]

FIRST_EPSILON, FIRST_DELTA = 0.1, 0.01
"""Before anything is known: few inliers, and a thin band of accidental ones around the epipolar lines.
docs/algorithms.md, Fundamental matrices. Chosen by hand; not measured on their own."""
MODEL_COST = {7: 160.0, 8: 160.0}
"""t_M: time for a sample and its models over the time to check one match, by sample size; measured (1.1 us, 7 ns). The
command is not on record; the figure stands in docs/algorithms.md, Fundamental matrices."""
MODELS_PER_SAMPLE = {7: 2.45, 8: 1.0}
"""m_S, by sample size; measured. The command is not on record; the thesis prints 2.3 (4.4.4)."""

_MOST_EPSILON = 0.999
"""Inlier share beyond which logarithms of 1 - epsilon are of no use. Chosen by hand; not measured on its own."""
_PRIOR_WEIGHT = 100.0
"""Checked matches that the first delta counts for. Chosen by hand; not measured on its own."""
_MOVED = 0.05
"""Relative change of delta that calls for a new test. docs/algorithms.md, Fundamental matrices. Chosen by hand; not
measured on its own."""
_REVIEW = 100
"""Most trials between two looks at delta. Chosen by hand; not measured on its own."""


@dataclass(frozen=True, slots=True)
class SequentialTest:
    """One test: the inlier probabilities it was made for, and its threshold."""

    epsilon: float
    """Of a match with a good model."""
    delta: float
    """Of a match with a bad model."""
    log_threshold: float
    """log A; inf where good and bad models look too alike to tell."""

    def least_inliers(self, count: int) -> IntArray:
        """Return (count,) inliers below which the ratio exceeds A after 1, 2, ... matches."""
        if math.isinf(self.log_threshold):
            return np.zeros(0, dtype=np.int64)
        hit, miss = self._steps()
        seen = np.arange(1, count + 1)
        # k hits and m - k misses: reject if k hit + (m - k) miss > log A
        least: IntArray = np.maximum(np.ceil((seen * miss - self.log_threshold) / (miss - hit)), 0).astype(np.int64)
        return least

    def pass_rate(self, share: float) -> float:
        """Return least probability that a good model passes whose true share of inliers is this one: 1 - A^-h."""
        if math.isinf(self.log_threshold):
            return 1.0
        return -math.expm1(-self.log_threshold * _exponent(*self._steps(), min(share, _MOST_EPSILON)))

    def _steps(self) -> tuple[float, float]:
        """Return what an inlier and an outlier add to the logarithm of the ratio."""
        return math.log(self.delta / self.epsilon), math.log((1 - self.delta) / (1 - self.epsilon))


@lru_cache(maxsize=1024)  # asked over and over for the same share
def _exponent(hit: float, miss: float, share: float) -> float:
    """Return the h > 0 with E[ratio^h] = 1 for matches of which `share` are inliers; 1 for the share of the design.

    0 if the ratio does not fall on average: such a model is sure to be rejected in the end.
    """
    if share * hit + (1 - share) * miss >= 0:
        return 0.0
    low, high = 0.0, 1.0
    while share * math.exp(high * hit) + (1 - share) * math.exp(high * miss) < 1:
        low, high = high, 2 * high
    for _ in range(60):
        middle = (low + high) / 2
        if share * math.exp(middle * hit) + (1 - share) * math.exp(middle * miss) < 1:
            low = middle
        else:
            high = middle
    return low


def design(epsilon: float, delta: float, sample_size: int) -> SequentialTest:
    """Return the fastest test for these probabilities: A = t_M C / m_S + 1 + log A.

    A larger A wastes matches on bad models, a smaller one wastes samples because good models fall.

    Args:
        epsilon: share of inliers of a good model, in (0, 1].
        delta: that of a bad one; a test needs 0 < delta < epsilon.
        sample_size: matches in a sample, 7 or 8.
    """
    epsilon = min(epsilon, _MOST_EPSILON)
    if not 0 < delta < epsilon:
        return SequentialTest(epsilon, delta, math.inf)
    # C: what one match of a bad model adds to the logarithm of the ratio on average
    gain = (1 - delta) * math.log((1 - delta) / (1 - epsilon)) + delta * math.log(delta / epsilon)
    cost = MODEL_COST[sample_size] * gain / MODELS_PER_SAMPLE[sample_size] + 1
    threshold = cost
    for _ in range(20):
        threshold = cost + math.log(threshold)
    return SequentialTest(epsilon, delta, math.log(threshold))


class Sprt:
    """The test as a verifier: made anew when the best model, or the bad ones, turn out to be other than thought."""

    review = _REVIEW

    def __init__(self, count: int, sample_size: int) -> None:
        self._count, self._sample_size = count, sample_size
        self._rejected = np.zeros(2, dtype=np.int64)
        self._past: list[tuple[SequentialTest, int]] = []
        self._begin(FIRST_EPSILON, FIRST_DELTA)

    def _begin(self, epsilon: float, delta: float) -> None:
        self._test, self._trials = design(epsilon, delta, self._sample_size), 0
        self.pretest = self.lenient = PreTest(self._test.least_inliers(self._count), 1, True, self._rejected)

    def _renew(self, epsilon: float) -> None:
        self._past.append((self._test, self._trials))
        self._begin(epsilon, self._delta())

    def _delta(self) -> float:
        """Return share of inliers among the matches that were checked on rejected models, and in what was assumed at
        first.
        """
        checked, inliers = self._rejected
        return float((inliers + FIRST_DELTA * _PRIOR_WEIGHT) / (checked + _PRIOR_WEIGHT))

    def learn(self, trials: int) -> None:
        """Count samples that were drawn and tested; where delta has changed the test is made anew."""
        self._trials += trials
        if abs(self._delta() - self._test.delta) > _MOVED * self._test.delta:
            self._renew(self._test.epsilon)

    def expect(self, share: float) -> None:
        """Make the test anew for this share of inliers, that of the best model."""
        self._renew(share)

    def trials_needed(self, share: float, confidence: float) -> float:
        """Return 3.19 over all tests that were in use: each left a clean sample standing with its own probability.

        Args:
            share: share of inliers, in [0, 1].
            confidence: wanted probability, in (0, 1).
        """
        clean = share**self._sample_size
        missed, drawn = 0.0, 0  # log-probability that all samples so far were unclean, or clean but rejected
        for test, trials in self._past:
            # a share of 1 would make past samples certain successes
            missed += trials * math.log1p(-min(clean * test.pass_rate(share), _MOST_EPSILON))
            drawn += trials
        return drawn + trials_needed(clean * self._test.pass_rate(share), confidence, missed)
