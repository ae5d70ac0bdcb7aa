"""Which hypotheses are worth scoring on all matches (thesis 4.4.4).

A hypothesis is checked match by match, and every test here comes down to one list: how many of the first m matches
must be inliers for it to go on. For the bail-out test and T(d,d) that is their definition. Wald's likelihood ratio
after m matches depends only on how many of them were inliers, so that its threshold is such a list too: the line of
rejection numbers of sequential sampling inspection.

Randomized tests begin at a random match, afresh for every hypothesis. In a fixed order all hypotheses would be judged
on the same first matches: if these are outliers every good model falls, however long the search goes on, while the
stopping rules count on errors that are independent from one hypothesis to the next.
"""

from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from sfm_app.ransac.sampling.stopping import trials_needed

IntArray = NDArray[np.int64]

BLOCK = 64
"""Matches between two looks at whether to go on, where no test asks for more. Chosen by hand for speed."""

LENIENCE = 0.5
"""Support that a model besides the priors must have, over that of the best sample, to be looked at. Chosen with the
other constants of lev-ransac (benchmarks/corpus/tuning_sets.py); not measured on its own."""
_BAIL_OUT_SIGMAS = 3.0
"""Standard deviations of the hypergeometric count that a hypothesis may fall short by (Capel 2005): one good one of a
thousand falls."""


class PreTest(NamedTuple):
    """A test as the inner loop runs it."""

    least_inliers: IntArray
    """Inliers that a hypothesis must show after each `stride` matches; empty for no test."""
    stride: int
    random_start: bool
    rejected: IntArray
    """(2,) matches checked on rejected hypotheses, and how many of them were inliers; the loop adds to it."""


def pretest(least_inliers: IntArray, stride: int, *, random_start: bool) -> PreTest:
    """Make a pre-test that has counted nothing.

    Args:
        least_inliers: (T,) inliers that must be seen by each look; empty for no test.
        stride: matches between two looks, > 0.
        random_start: begin at a random match for every hypothesis, not at the first.
    """
    return PreTest(least_inliers, stride, random_start, np.zeros(2, dtype=np.int64))


OPEN = pretest(np.zeros(0, dtype=np.int64), BLOCK, random_start=False)
"""No test: every hypothesis is scored in full, or until it cannot win."""


class Verifier(Protocol):
    """A test, what it learns during a search, and the trials that its mistakes cost."""

    pretest: PreTest
    lenient: PreTest
    """For models of samples that owe nothing to the priors."""
    review: int
    """Most trials between two calls of `learn`."""

    def learn(self, trials: int) -> None:
        """Count samples that were drawn and tested."""

    def expect(self, share: float) -> None:
        """Expect this share of inliers, that of the best model."""

    def trials_needed(self, share: float, confidence: float) -> float:
        """Return samples, those already drawn included, that hold with this probability a clean one which passes.

        Args:
            share: share of inliers, in [0, 1].
            confidence: wanted probability, in (0, 1).
        """


class FullVerification:
    """All hypotheses are scored on all matches."""

    review = 2**62

    def __init__(self, count: int, sample_size: int) -> None:
        self.count, self.sample_size = count, sample_size
        self.pretest = self.lenient = OPEN

    def learn(self, trials: int) -> None:
        """Take no notice of samples that were drawn and tested."""

    def expect(self, share: float) -> None:
        """Take no notice of the best model's share of inliers."""

    def trials_needed(self, share: float, confidence: float) -> float:
        """Return samples that hold with this probability a clean one.

        Args:
            share: share of inliers, in [0, 1].
            confidence: wanted probability, in (0, 1).
        """
        return trials_needed(share**self.sample_size, confidence)


class BailOut(FullVerification):
    """Leave a hypothesis that falls behind the best one (Capel 2005), seen on the matches in their random order."""

    def expect(self, share: float) -> None:
        """Make both tests for this share of inliers, that of the best model."""
        least = bail_out_table(self.count, share)
        self.pretest = pretest(least, BLOCK, random_start=False)
        self.lenient = pretest((LENIENCE * least).astype(np.int64), BLOCK, random_start=False)


class RandomisedTdd(FullVerification):
    """T(d,d): the first d matches must all be inliers (Matas and Chum 2004); d = 1 is the best choice there.

    A clean model passes with probability share^d, and the samples needed are that much more.
    """

    d = 1

    def __init__(self, count: int, sample_size: int) -> None:
        super().__init__(count, sample_size)
        self.pretest = self.lenient = pretest(np.arange(1, self.d + 1), 1, random_start=True)

    def trials_needed(self, share: float, confidence: float) -> float:
        """Return samples that hold with this probability a clean one which passes.

        Args:
            share: share of inliers, in [0, 1].
            confidence: wanted probability, in (0, 1).
        """
        return trials_needed(share ** (self.sample_size + self.d), confidence)


def bail_out_table(count: int, inlier_share: float) -> IntArray:
    """Return how many inliers a hypothesis must show after each block to be worth finishing.

    A hypothesis as good as the best one has a share `inlier_share` of inliers; in the first m of N matches their
    number is hypergeometric, and falls short of the figures given here about once in a thousand times.

    Args:
        count: number of matches.
        inlier_share: that of the best model, in [0, 1].

    Returns:
        (blocks,) counts.
    """
    seen = np.arange(BLOCK, count, BLOCK, dtype=np.float64)
    mean = seen * inlier_share
    deviation = np.sqrt(mean * (1 - inlier_share) * (count - seen) / max(count - 1, 1))
    return np.maximum(np.floor(mean - _BAIL_OUT_SIGMAS * deviation), 0).astype(np.int64)
