"""Whether a model's support could be luck (a-contrario reasoning: Moisan and Stival 2004)."""

import math

import numpy as np
from numpy.typing import NDArray
from scipy.special import gammaln

from sfm_app.ransac.sampling import SAMPLE_SIZE
from sfm_app.ransac.scoring import squared_distances

FloatArray = NDArray[np.float64]

MOST_MODELS_PER_SAMPLE = 3
MOST_FALSE_ALARMS = 1e-2
"""A pair is kept when less than this many models of its support are expected in random matches."""

_FRACTIONS = (1.0, 0.5, 0.25)
"""The support is also judged at these fractions of the threshold: precise inliers are stronger evidence."""
_MISMATCHES = 20000


def expected_false_alarms(points: FloatArray, f: FloatArray, threshold: float) -> float:
    """How many models with the support of f one expects among random matches of the same points; capped at 1e300.

    Every model through seven of the N matches is a chance: 3 C(N, 7) of them. Each of the other N - 7 matches agrees with
    one by accident with probability a. So the expectation is 3 C(N, 7) P(Binomial(N - 7, a) >= k - 7) for k inliers. The
    probability a is measured, not modelled: it is the share of deliberate mismatches (a point of view 1 with the partner of
    another one) that agree with f. It thus knows the extent of the photos, where their points cluster, and the epipoles.

    Args:
        points: (N, 4) distinct matches in random order.
        f: (9,) model.
        threshold: largest distance of an inlier.
    """
    count = len(points)
    if count <= SAMPLE_SIZE:
        return 1e300
    squared, wrong = squared_distances(points, f), squared_distances(mismatches(points), f)
    tests = math.log(MOST_MODELS_PER_SAMPLE * len(_FRACTIONS)) + _log_choose(count, SAMPLE_SIZE)
    lowest = math.inf
    for fraction in _FRACTIONS:
        limit = (fraction * threshold) ** 2
        chance = (np.count_nonzero(wrong <= limit) + 1.0) / (len(wrong) + 2.0)
        agreeing = int(np.count_nonzero(squared <= limit)) - SAMPLE_SIZE
        lowest = min(lowest, tests + log_binomial_tail(count - SAMPLE_SIZE, agreeing, chance))
    return math.exp(min(lowest, 690.0))


def mismatches(points: FloatArray) -> FloatArray:
    """(M, 4) pairs of points that do not belong together: each point of view 1 with the partners of some others."""
    shifts = min(len(points) - 1, max(1, _MISMATCHES // len(points)))
    return np.vstack([np.hstack([points[:, :2], np.roll(points[:, 2:], s, axis=0)]) for s in range(1, shifts + 1)])


def log_binomial_tail(count: int, least: int, chance: float) -> float:
    """log P(Binomial(count, chance) >= least)."""
    if least <= 0:
        return 0.0
    if least > count:
        return -math.inf
    k = np.arange(least, count + 1)
    logs = gammaln(count + 1) - gammaln(k + 1) - gammaln(count - k + 1) + k * math.log(chance)
    logs += (count - k) * math.log1p(-chance)
    top = float(logs.max())
    return min(0.0, top + math.log(float(np.exp(logs - top).sum())))


def _log_choose(n: int, k: int) -> float:
    return math.lgamma(n + 1) - math.lgamma(k + 1) - math.lgamma(n - k + 1)
