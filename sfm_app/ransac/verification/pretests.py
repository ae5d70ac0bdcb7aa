"""Tests that decide which hypotheses are scored on all matches (thesis 4.4.4).

A hypothesis is checked match by match, and every test here is one list: how many of the first m matches must be inliers
for the check to continue. The bail-out test and T(d,d) are defined this way. Wald's likelihood ratio after m matches
depends only on how many of them were inliers, so that its threshold is such a list, too: the line of rejection numbers
of sequential sampling inspection.

Randomized tests begin at a new random match for every hypothesis. In a fixed order all hypotheses would be tested on
the same first matches: if these are outliers, every good model is rejected, however long the search is. The stopping
rules assume errors that are independent between hypotheses.
"""

from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from sfm_app.ransac.sampling.stopping import required_trials

IntArray = NDArray[np.int64]

BLOCK = 64
"""Matches between two checks for an early exit, where no test needs more. Chosen by hand for speed."""

LENIENCE = 0.5
"""Least support of a model drawn without the priors, relative to that of the best sample. Chosen with the other
constants of lev-ransac (benchmarks/corpus/tuning_sets.py); not measured on its own."""
_BAIL_OUT_SIGMAS = 3.0
"""Standard deviations that the hypergeometric count of a hypothesis may fall short by (Capel 2005): one of a thousand
good hypotheses is rejected."""


class PreTest(NamedTuple):
    """A test and its statistics, as passed to kernels."""

    least_inliers: IntArray
    """Inliers that a hypothesis must have after each `stride` matches; empty for no test."""
    stride: int
    random_start: bool
    rejected: IntArray
    """(2,) matches checked on rejected hypotheses, and how many of them were inliers; the loop adds to it."""


def make_pretest(least_inliers: IntArray, stride: int, *, random_start: bool) -> PreTest:
    """Make a pre-test with counts of 0.

    Args:
        least_inliers: (T,) inliers that a hypothesis must have at each check; empty for no test.
        stride: matches between two checks, > 0.
        random_start: begin at a random match for every hypothesis, not at the first.
    """
    return PreTest(least_inliers, stride, random_start, np.zeros(2, dtype=np.int64))


NO_PRETEST = make_pretest(np.zeros(0, dtype=np.int64), BLOCK, random_start=False)
"""No test: every hypothesis is scored in full, or until it cannot win."""


class Verifier(Protocol):
    """A test that adapts during a search, and the number of trials that allows for its errors."""

    pretest: PreTest
    lenient: PreTest
    """Test of models from samples drawn without the priors."""
    review: int
    """Largest number of trials between two calls of `learn`."""

    def learn(self, trials: int) -> None:
        """Count samples that were drawn and tested."""

    def expect(self, share: float) -> None:
        """Expect this share of inliers, that of the best model."""

    def required_trials(self, share: float, confidence: float) -> float:
        """Return how many samples, those already drawn included, give a clean one that passes with this probability.

        Args:
            share: share of inliers, in [0, 1].
            confidence: wanted probability, in (0, 1).
        """


class FullVerification:
    """All hypotheses are scored on all matches."""

    review = 2**62

    def __init__(self, count: int, sample_size: int) -> None:
        self.count, self.sample_size = count, sample_size
        self.pretest = self.lenient = NO_PRETEST

    def learn(self, trials: int) -> None:
        """Do nothing: the test does not depend on the samples."""

    def expect(self, share: float) -> None:
        """Do nothing: the test does not depend on the share of inliers."""

    def required_trials(self, share: float, confidence: float) -> float:
        """Return how many samples give a clean one with this probability.

        Args:
            share: share of inliers, in [0, 1].
            confidence: wanted probability, in (0, 1).
        """
        return required_trials(share**self.sample_size, confidence)


class BailOut(FullVerification):
    """Reject a hypothesis once it has too few inliers to be the best one (Capel 2005); matches are in random order."""

    def expect(self, share: float) -> None:
        """Make both tests for this share of inliers, that of the best model."""
        least = bail_out_table(self.count, share)
        self.pretest = make_pretest(least, BLOCK, random_start=False)
        self.lenient = make_pretest((LENIENCE * least).astype(np.int64), BLOCK, random_start=False)


class RandomizedTdd(FullVerification):
    """T(d,d): the first d matches must all be inliers (Matas and Chum 2004, who find d = 1 best).

    A clean model passes with probability share^d, so that more samples are needed.
    """

    d = 1

    def __init__(self, count: int, sample_size: int) -> None:
        super().__init__(count, sample_size)
        self.pretest = self.lenient = make_pretest(np.arange(1, self.d + 1), 1, random_start=True)

    def required_trials(self, share: float, confidence: float) -> float:
        """Return how many samples give a clean one that passes with this probability.

        Args:
            share: share of inliers, in [0, 1].
            confidence: wanted probability, in (0, 1).
        """
        return required_trials(share ** (self.sample_size + self.d), confidence)


def bail_out_table(count: int, inlier_share: float) -> IntArray:
    """Return how many inliers a hypothesis must have after each block to be scored further.

    A hypothesis as good as the best one has a share `inlier_share` of inliers; in the first m of N matches their number
    is hypergeometric, and is below the returned counts about once in a thousand times.

    Args:
        count: number of matches.
        inlier_share: share of inliers of the best model, in [0, 1].

    Returns:
        (blocks,) counts.
    """
    seen = np.arange(BLOCK, count, BLOCK, dtype=np.float64)
    mean = seen * inlier_share
    deviation = np.sqrt(mean * (1 - inlier_share) * (count - seen) / max(count - 1, 1))
    return np.maximum(np.floor(mean - _BAIL_OUT_SIGMAS * deviation), 0).astype(np.int64)
