"""Pre-tests of models before they are scored: bail-out, T(d,d) and sequential probability ratio (thesis 4.4.4)."""

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from sfm_app.fundamental.samples import SAMPLE_SIZE, required_trials
from sfm_app.types.arrays import IndexArray

# Every pre-test is one list: how many of the first m matches must be inliers for the check of a hypothesis to continue.
# Wald's likelihood ratio after m matches depends only on how many of them were inliers, so that its threshold is such
# a list, too.
#
# Randomized pre-tests begin at a new random match for every hypothesis. In a fixed order, outliers among the first
# matches would reject every good model. The stopping rules assume errors that are independent between hypotheses.

BLOCK = 64
"""Matches between two checks for an early exit, where no test needs more. Chosen by hand for speed."""

LENIENCE = 0.5
"""Least support of a model drawn without the priors, relative to that of the best sample. Chosen with the constants of
`lev_ransac` (benchmarks/corpus/tuning_sets.py); not measured on its own."""


class PreTest(NamedTuple):
    """A pre-test and its statistics, as passed to kernels."""

    least_inliers: IndexArray
    """Inliers that a hypothesis must have after each `stride` matches; empty for no pre-test."""
    stride: int
    random_start: bool
    rejected: IndexArray
    """(2,) matches checked on rejected hypotheses, and how many of them were inliers; the loop adds to it."""


def make_pretest(least_inliers: IndexArray, stride: int, *, random_start: bool) -> PreTest:
    """Make a pre-test with counts of 0 from the inliers (T,) that a hypothesis must have at each check."""
    return PreTest(least_inliers, stride, random_start, np.zeros(2, dtype=np.int64))


NO_PRETEST = make_pretest(np.zeros(0, dtype=np.int64), BLOCK, random_start=False)
"""No pre-test: every hypothesis is scored in full, or until it cannot win."""


class FullScoring:
    """No pre-test: all hypotheses are scored on all matches. Other pre-tests adapt during a search."""

    review = 2**62
    """Largest number of trials between two calls of `learn`."""
    pretest: PreTest
    lenient: PreTest
    """Pre-test of models from samples drawn without the priors."""

    def __init__(self, count: int, sample_size: int) -> None:
        self.count, self.sample_size = count, sample_size
        self.pretest = self.lenient = NO_PRETEST

    def learn(self, trials: int) -> None:
        """Count samples that were drawn and pre-tested."""

    def expect(self, share: float) -> None:
        """Expect this share of inliers, that of the best model."""

    def required_trials(self, share: float, confidence: float) -> float:
        """Return how many samples, drawn ones included, give a clean one that passes with probability `confidence`."""
        return required_trials(share**self.sample_size, confidence)


class BailOut(FullScoring):
    """Reject a hypothesis once it has too few inliers to be the best one (Capel 2005); matches are in random order."""

    def expect(self, share: float) -> None:
        """Make both pre-tests for this share of inliers."""
        least = bail_out_table(self.count, share)
        self.pretest = make_pretest(least, BLOCK, random_start=False)
        self.lenient = make_pretest((LENIENCE * least).astype(np.int64), BLOCK, random_start=False)


class RandomizedTdd(FullScoring):
    """T(d,d): the first d matches must all be inliers (Matas and Chum 2004); clean models pass by share^d."""

    d = 1

    def __init__(self, count: int, sample_size: int) -> None:
        super().__init__(count, sample_size)
        self.pretest = self.lenient = make_pretest(np.arange(1, self.d + 1), 1, random_start=True)

    def required_trials(self, share: float, confidence: float) -> float:
        """Return how many samples give a clean one that passes with this probability."""
        return required_trials(share ** (self.sample_size + self.d), confidence)


def bail_out_table(count: int, inlier_share: float) -> IndexArray:
    """Return how many inliers (blocks,) a hypothesis must have after each block to be scored further.

    A hypothesis as good as the best one has a share `inlier_share` of inliers; in the first m of N matches their number
    is hypergeometric, and is three standard deviations below its mean about once in a thousand times (Capel 2005).
    """
    checked = np.arange(BLOCK, count, BLOCK, dtype=np.float64)
    mean = checked * inlier_share
    deviation = np.sqrt(mean * (1 - inlier_share) * (count - checked) / max(count - 1, 1))
    return np.maximum(np.floor(mean - 3.0 * deviation), 0).astype(np.int64)


# Wald's sequential probability ratio test of hypotheses (Matas and Chum 2005, Chum and Matas 2008; thesis 4.9).
# Matches are inliers of a good model with probability epsilon, of a bad one with probability delta. The likelihood
# ratio of "bad" to "good" is multiplied up match by match; above A the model is rejected, which happens to a good one
# with a probability of at most 1/A.


class SPRT:
    """Times, first guesses and limits of the sequential test; guesses and limits were chosen by hand."""

    model_cost: float = 160.0
    """t_M: time for a sample and its models over the time to check one match; measured, 1.1 us and 7 ns
    (docs/algorithms/fundamental-matrices.md)."""
    models: tuple[float, float] = (2.45, 1.0)
    """m_S: models through a sample of seven and of eight; measured. The thesis prints 2.3 (4.4.4)."""
    first_epsilon: float = 0.1
    """First epsilon: few inliers (docs/algorithms/fundamental-matrices.md)."""
    first_delta: float = 0.01
    """First delta: few chance inliers near epipolar lines (docs/algorithms/fundamental-matrices.md)."""
    most_epsilon: float = 0.999
    """Largest epsilon: beyond it the logarithm of 1 - epsilon is useless."""
    prior_weight: float = 100.0
    """Weight of the first delta, in checked matches."""
    delta_tolerance: float = 0.05
    """Relative change of delta that calls for a new test (docs/algorithms/fundamental-matrices.md)."""
    review: int = 100
    """Largest number of trials between two updates of delta."""


@dataclass(frozen=True, slots=True)
class SequentialTest:
    """One test: the inlier probabilities it was designed for, and its threshold."""

    epsilon: float
    """Probability that a match is an inlier of a good model."""
    delta: float
    """Probability that a match is an inlier of a bad model."""
    log_threshold: float
    """log A; inf where delta and epsilon allow no test."""

    def least_inliers(self, count: int) -> IndexArray:
        """Return (count,) numbers of inliers below which the ratio exceeds A after 1, 2, ... matches."""
        if math.isinf(self.log_threshold):
            return np.zeros(0, dtype=np.int64)
        hit, miss = self._log_steps()
        checked = np.arange(1, count + 1)
        # k hits and m - k misses: reject if k hit + (m - k) miss > log A
        least: IndexArray = np.maximum(np.ceil((checked * miss - self.log_threshold) / (miss - hit)), 0).astype(
            np.int64
        )
        return least

    def pass_rate(self, share: float) -> float:
        """Return the least probability that a good model with this true share of inliers passes: 1 - A^-h."""
        if math.isinf(self.log_threshold):
            return 1.0
        return -math.expm1(-self.log_threshold * _exponent(*self._log_steps(), min(share, SPRT.most_epsilon)))

    def _log_steps(self) -> tuple[float, float]:
        """Return the increments of the log-likelihood ratio for an inlier and for an outlier."""
        return math.log(self.delta / self.epsilon), math.log((1 - self.delta) / (1 - self.epsilon))


@lru_cache(maxsize=1024)  # called repeatedly with the same share
def _exponent(hit: float, miss: float, share: float) -> float:
    """Return the h > 0 with E[ratio^h] = 1, `share` of the matches inliers; 0 if the ratio does not decrease."""
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
    """Return the fastest test: A = t_M C / m_S + 1 + log A; without 0 < delta < epsilon, no test.

    A larger A wastes matches on bad models; a smaller one wastes samples, because good models are rejected.
    """
    epsilon = min(epsilon, SPRT.most_epsilon)
    if not 0 < delta < epsilon:
        return SequentialTest(epsilon, delta, math.inf)
    # C: average increment of the log-likelihood ratio per match of a bad model
    gain = (1 - delta) * math.log((1 - delta) / (1 - epsilon)) + delta * math.log(delta / epsilon)
    cost = SPRT.model_cost * gain / SPRT.models[sample_size - SAMPLE_SIZE] + 1
    threshold = cost
    for _ in range(20):
        threshold = cost + math.log(threshold)
    return SequentialTest(epsilon, delta, math.log(threshold))


class Sprt(FullScoring):
    """The test as an adaptive pre-test, designed again when the estimate of epsilon or delta changes."""

    review = SPRT.review

    def __init__(self, count: int, sample_size: int) -> None:
        super().__init__(count, sample_size)
        self._rejected = np.zeros(2, dtype=np.int64)
        self._past: list[tuple[SequentialTest, int]] = []
        self._begin(SPRT.first_epsilon, SPRT.first_delta)

    def _begin(self, epsilon: float, delta: float) -> None:
        self._test, self._trials = design(epsilon, delta, self.sample_size), 0
        self.pretest = self.lenient = PreTest(self._test.least_inliers(self.count), 1, True, self._rejected)

    def _renew(self, epsilon: float) -> None:
        self._past.append((self._test, self._trials))
        self._begin(epsilon, self._delta())

    def _delta(self) -> float:
        """Return the share of inliers among the matches checked on rejected models, with the initial delta as prior."""
        checked, inliers = self._rejected
        return float((inliers + SPRT.first_delta * SPRT.prior_weight) / (checked + SPRT.prior_weight))

    def learn(self, trials: int) -> None:
        """Count samples; design a new test if delta has changed."""
        self._trials += trials
        if abs(self._delta() - self._test.delta) > SPRT.delta_tolerance * self._test.delta:
            self._renew(self._test.epsilon)

    def expect(self, share: float) -> None:
        """Make a new test for this share of inliers."""
        self._renew(share)

    def required_trials(self, share: float, confidence: float) -> float:
        """Return the number of samples by (3.19); each test so far passed clean samples with its own probability."""
        clean = share**self.sample_size
        missed, drawn = 0.0, 0  # log-probability that all samples so far were contaminated, or clean but rejected
        for test, trials in self._past:
            # with a share of 1, past samples would be certain successes
            missed += trials * math.log1p(-min(clean * test.pass_rate(share), SPRT.most_epsilon))
            drawn += trials
        return drawn + required_trials(clean * self._test.pass_rate(share), confidence, missed)
