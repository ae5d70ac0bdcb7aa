"""Whether a model's support could be luck (a-contrario reasoning: Moisan and Stival 2004)."""

import math

import numpy as np
from numpy.typing import NDArray
from scipy.special import gammaln

from sfm_app.jit import kernel
from sfm_app.ransac.minimal import MOST_MODELS
from sfm_app.ransac.sampling import SAMPLE_SIZE
from sfm_app.ransac.scoring import squared_distances, squared_sampson

FloatArray = NDArray[np.float64]

MOST_FALSE_ALARMS = 1e-2
"""Support counts as real when less than this many models with as much of it are expected in random matches."""

_FRACTIONS = (1.0, 0.5, 0.25)
"""Support is judged at these fractions of the threshold: precise inliers are stronger evidence."""
_MISMATCHES = 20000
_MOST = 1e300


def false_alarms_of(distances: FloatArray, wrong: FloatArray, threshold: float) -> float:
    """How many models with as much support are expected among random matches of the same points.

    Args:
        distances: (N,) of the matches to the model.
        wrong: (M,) of mismatches, from `mismatch_distances`.
        threshold: largest distance of an inlier.
    """
    tried = []
    for fraction in _FRACTIONS:
        inliers = int(np.count_nonzero(distances <= fraction * threshold))
        chance = accidental_share(wrong, fraction * threshold)
        tried.append(false_alarms(len(distances), inliers, SAMPLE_SIZE, chance))
    return min(_MOST, len(_FRACTIONS) * MOST_MODELS * min(tried))


def is_credible(points: FloatArray, f: FloatArray, threshold: float) -> bool:
    """Whether the support of f is more than luck.

    Args:
        points: (N, 4) distinct matches in random order, N >= 2.
        f: (9,) model.
        threshold: largest distance of an inlier.
    """
    distances, wrong = np.sqrt(squared_distances(points, f)), mismatch_distances(points, f)
    return false_alarms_of(distances, wrong, threshold) <= MOST_FALSE_ALARMS


def false_alarms(count: int, inliers: int, sample_size: int, chance: float) -> float:
    """Expected number of minimal samples whose model has so many inliers, if every match is wrong.

    Each of the C(count, s) samples agrees with itself, and with each of the other matches by accident, so that the
    expectation is C(count, s) P(Binomial(count - s, chance) >= inliers - s).

    Args:
        count: all matches.
        inliers: those that agree with the model.
        sample_size: s, the matches that determine a model.
        chance: probability that a wrong match agrees with a model, in (0, 1).

    Returns:
        The number, at most 1e300.
    """
    if inliers <= sample_size:
        return _MOST
    logarithm = _log_choose(count, sample_size) + log_binomial_tail(count - sample_size, inliers - sample_size, chance)
    return min(_MOST, math.exp(min(logarithm, 700.0)))


def mismatch_distances(points: FloatArray, f: FloatArray) -> FloatArray:
    """(M,) Sampson distances of deliberate mismatches: each point of view 1 with the partners of some others.

    Args:
        points: (N, 4) distinct matches in random order, N >= 2.
        f: (9,) model.
    """
    shifts = min(len(points) - 1, max(1, _MISMATCHES // len(points)))
    return np.sqrt(_squared_mismatches(points, f, shifts))


@kernel
def _squared_mismatches(points: FloatArray, f: FloatArray, shifts: int) -> FloatArray:
    count = points.shape[0]
    squared = np.empty(shifts * count)
    for shift in range(shifts):
        for i in range(count):
            j = (i + shift + 1) % count
            squared[shift * count + i] = squared_sampson(f, points[i, 0], points[i, 1], points[j, 2], points[j, 3])
    return squared


def accidental_share(wrong: FloatArray, threshold: float) -> float:
    """Probability that a wrong match agrees with a model, in (0, 1), from its distances to mismatches.

    Measured, not modelled: it knows the extent of the photos, where their points cluster, and where the epipoles are.
    """
    return (int(np.count_nonzero(wrong <= threshold)) + 1.0) / (len(wrong) + 2.0)


def log_binomial_tail(count: int, least: int, chance: float) -> float:
    """log P(Binomial(count, chance) >= least), for a chance in (0, 1)."""
    if least <= 0:
        return 0.0
    if least > count:
        return -math.inf
    k = np.arange(least, count + 1)
    logs = gammaln(count + 1) - gammaln(k + 1) - gammaln(count - k + 1)
    logs += k * math.log(chance) + (count - k) * math.log1p(-chance)
    top = float(logs.max())
    return min(0.0, top + math.log(float(np.exp(logs - top).sum())))


def _log_choose(n: int, k: int) -> float:
    return math.lgamma(n + 1) - math.lgamma(k + 1) - math.lgamma(n - k + 1)
