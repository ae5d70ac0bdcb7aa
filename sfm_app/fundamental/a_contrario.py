"""Whether a model's support could be chance (a-contrario reasoning: Moisan and Stival 2004)."""

import math

import numpy as np

from sfm_app.fundamental.samples import SAMPLE_SIZE
from sfm_app.fundamental.scores import squared_distances
from sfm_app.fundamental.solvers import MOST_MODELS
from sfm_app.types.arrays import FloatArray

MOST_FALSE_ALARMS = 1e-2
"""Expected number of models with as much support in random matches, above which support counts as chance.
docs/algorithms/lev-ransac.md. Chosen by hand; not measured on its own."""


def model_false_alarms(squared: FloatArray, wrong: FloatArray, threshold: float) -> float:
    """Return the expected number of models with as much support in random matches, from squared distances."""
    fractions = 1.0, 0.5, 0.25  # precise inliers are stronger evidence; docs/algorithms/lev-ransac.md
    alarms = []
    for fraction in fractions:
        inliers = int(np.count_nonzero(squared <= (fraction * threshold) ** 2))
        chance = accidental_share(wrong, fraction * threshold)
        alarms.append(false_alarms(len(squared), inliers, SAMPLE_SIZE, chance))
    return min(1e300, len(fractions) * MOST_MODELS * min(alarms))


def false_alarms(count: int, inliers: int, sample_size: int, chance: float) -> float:
    """Return an upper bound, at most 1e300, of the samples whose model has so many inliers if all matches are wrong.

    Each of the C(count, s) samples agrees with itself, and with each of the other matches by chance: the expectation is
    C(count, s) P(Binomial(count - s, chance) >= inliers - s).
    """
    if inliers <= sample_size:
        return 1e300
    rest = count - sample_size
    choices = math.lgamma(count + 1) - math.lgamma(sample_size + 1) - math.lgamma(rest + 1)
    logarithm = choices + log_binomial_tail(rest, inliers - sample_size, chance)
    return min(1e300, math.exp(min(logarithm, 700.0)))


def squared_mismatch_distances(points: FloatArray, f: FloatArray) -> FloatArray:
    """Return (M,) squared Sampson distances of points of view 1 with the partners of other points; N >= 2."""
    shifts = range(1, min(len(points) - 1, max(1, 8000 // len(points))) + 1)
    partners = np.vstack([np.roll(points[:, 2:], -shift, axis=0) for shift in shifts])
    return squared_distances(np.asfortranarray(np.hstack([np.tile(points[:, :2], (len(shifts), 1)), partners])), f)


def accidental_share(wrong: FloatArray, threshold: float) -> float:
    """Return the measured probability that a wrong match agrees with a model, from squared mismatch distances (M,)."""
    return (int(np.count_nonzero(wrong <= threshold * threshold)) + 1.0) / (len(wrong) + 2.0)


def log_binomial_tail(count: int, least: int, chance: float) -> float:
    """Return an upper bound of log P(Binomial(count, chance) >= least) (Chernoff 1952); `chance` in (0, 1)."""
    share = least / count
    if share <= chance:
        return 0.0
    if share > 1:
        return -math.inf
    divergence = share * math.log(share / chance)
    if share < 1:
        divergence += (1 - share) * math.log((1 - share) / (1 - chance))
    return -count * divergence
