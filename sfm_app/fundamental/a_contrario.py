"""Whether a model's support could be chance (a-contrario reasoning: Moisan and Stival 2004)."""

import math

import numpy as np

from sfm_app.fundamental.samples import SAMPLE_SIZE
from sfm_app.fundamental.scores import squared_sampson_distance
from sfm_app.fundamental.solvers import MOST_MODELS
from sfm_app.jit import kernel
from sfm_app.types.arrays import FloatArray

MOST_FALSE_ALARMS = 1e-2
"""Support counts as real when fewer than this number of models with as much are expected in random matches.
docs/algorithms.md, All estimators. Chosen by hand; not measured on its own."""

_FRACTIONS = (1.0, 0.5, 0.25)
"""Support is judged at these fractions of the threshold: precise inliers are stronger evidence. docs/algorithms.md, All
estimators. Chosen by hand; not measured on their own."""
_MISMATCHES = 8000
"""Approximate number of mismatches that measure chance agreement. Chosen by hand; not measured on its own."""
_LARGEST_COUNT = 1e300
"""Largest number of false alarms that is returned: near the largest number in double precision."""


def model_false_alarms(squared: FloatArray, wrong: FloatArray, threshold: float) -> float:
    """Return the expected number of models with as much support among random matches of the same points.

    Args:
        squared: (N,) squared distances of the matches to the model.
        wrong: (M,) those of mismatches, from `a_contrario.squared_mismatch_distances`.
        threshold: largest distance of an inlier.
    """
    tried = []
    for fraction in _FRACTIONS:
        inliers = int(np.count_nonzero(squared <= (fraction * threshold) ** 2))
        chance = accidental_share(wrong, fraction * threshold)
        tried.append(false_alarms(len(squared), inliers, SAMPLE_SIZE, chance))
    return min(_LARGEST_COUNT, len(_FRACTIONS) * MOST_MODELS * min(tried))


def false_alarms(count: int, inliers: int, sample_size: int, chance: float) -> float:
    """Return the expected number of minimal samples whose model has this many inliers, if every match is wrong.

    Each of the C(count, s) samples agrees with itself, and with each of the other matches by chance, so that the
    expectation is C(count, s) P(Binomial(count - s, chance) >= inliers - s).

    Args:
        count: number of matches.
        inliers: number of matches that agree with the model.
        sample_size: s, the matches that determine a model.
        chance: probability that a wrong match agrees with a model, in (0, 1).

    Returns:
        An upper bound of the number, at most 1e300.
    """
    if inliers <= sample_size:
        return _LARGEST_COUNT
    logarithm = _log_choose(count, sample_size) + log_binomial_tail(count - sample_size, inliers - sample_size, chance)
    return min(_LARGEST_COUNT, math.exp(min(logarithm, 700.0)))


def squared_mismatch_distances(points: FloatArray, f: FloatArray) -> FloatArray:
    """Return (M,) squared Sampson distances of deliberate mismatches.

    Each pairs a point of view 1 with the partner of another point.

    Args:
        points: (N, 4) distinct matches in random order, N >= 2.
        f: (9,) model.
    """
    return _shifted_distances(points, f, min(len(points) - 1, max(1, _MISMATCHES // len(points))))


@kernel
def _shifted_distances(points: FloatArray, f: FloatArray, shifts: int) -> FloatArray:
    count = points.shape[0]
    wrong = np.empty(shifts * count)
    for shift in range(shifts):
        for i in range(count):
            partner = (i + shift + 1) % count
            wrong[shift * count + i] = squared_sampson_distance(
                f, points[i, 0], points[i, 1], points[partner, 2], points[partner, 3]
            )
    return wrong


def accidental_share(wrong: FloatArray, threshold: float) -> float:
    """Return the probability that a wrong match agrees with a model, in (0, 1).

    It is measured, not modeled, and so includes the extent of the photos, clusters of points and the epipoles.

    Args:
        wrong: (M,) squared distances of mismatches to the model.
        threshold: largest distance of an inlier, in the same units.
    """
    return (int(np.count_nonzero(wrong <= threshold * threshold)) + 1.0) / (len(wrong) + 2.0)


def log_binomial_tail(count: int, least: int, chance: float) -> float:
    """Return an upper bound of log P(Binomial(count, chance) >= least) (Chernoff 1952).

    Args:
        count: number of trials, > 0.
        least: least number of successes.
        chance: probability of one success, in (0, 1).
    """
    share = least / count
    if share <= chance:
        return 0.0
    if share > 1:
        return -math.inf
    divergence = share * math.log(share / chance)
    if share < 1:
        divergence += (1 - share) * math.log((1 - share) / (1 - chance))
    return -count * divergence


def _log_choose(n: int, k: int) -> float:
    return math.lgamma(n + 1) - math.lgamma(k + 1) - math.lgamma(n - k + 1)
