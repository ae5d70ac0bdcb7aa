"""Scores of a model: penalties on the Sampson distances of all matches, with early exits (thesis 4.4.1)."""

import math
from collections.abc import Callable
from typing import NamedTuple, cast

import numpy as np

from sfm_app.fundamental.pretests import BLOCK, PreTest
from sfm_app.jit import kernel
from sfm_app.types.arrays import FloatArray

# Penalties are minimized. A score is a function (points, threshold, best model or None) -> `Loss`, called again at
# every new best model; only that of MLESAC changes during the search.

FIRST = cast("int", np.int64(0))
"""Start of the first block: 0, by definition. Numba types a literal 0 separately, and would compile kernels twice."""

RANSAC, MSAC, MSAC_LINEAR, MLESAC, LMEDS, GEMAN_MCCLURE = range(6)
"""Kinds of `Loss`, one for each penalty below. A new score needs a number here and a branch in `_cost`."""


class Loss(NamedTuple):
    """A penalty and its parameters, as passed to kernels."""

    kind: int
    limit: float
    """Largest squared distance of an inlier."""
    reach: float
    """Squared distance beyond which every match costs `worst`."""
    worst: float
    precision: float = 0.0
    """MLESAC: 1 / (2 sigma^2). Geman-McClure: 1 / c^2."""
    odds: float = 0.0
    """MLESAC: density of the outliers over that of the inliers at distance 0."""


Score = Callable[[FloatArray, float, FloatArray | None], Loss]


def ransac(_points: FloatArray, threshold: float, _best: FloatArray | None) -> Loss:
    """Return the `Loss` that counts outliers: 1 for each match beyond the threshold (thesis 3.20, 4.4)."""
    return Loss(RANSAC, threshold * threshold, threshold * threshold, 1.0)


def msac(_points: FloatArray, threshold: float, _best: FloatArray | None) -> Loss:
    """Return the `Loss` of squared distances, at most the squared threshold (Torr and Zisserman 2000)."""
    return Loss(MSAC, threshold * threshold, threshold * threshold, threshold * threshold)


def msac_linear(_points: FloatArray, threshold: float, _best: FloatArray | None) -> Loss:
    """Return the `Loss` of distances, at most the threshold (thesis 4.5 as printed)."""
    return Loss(MSAC_LINEAR, threshold * threshold, threshold * threshold, threshold)


def lmeds(_points: FloatArray, threshold: float, _best: FloatArray | None) -> Loss:
    """Return the `Loss` that is the median of the squared distances (Rousseeuw 1984; thesis 4.4.1)."""
    return Loss(LMEDS, threshold * threshold, np.inf, np.inf)


def geman_mcclure(_points: FloatArray, threshold: float, _best: FloatArray | None, *, scale: float) -> Loss:
    """Return the `Loss` r^2 / (r^2 + c^2), c = `scale` thresholds (Geman and McClure 1987)."""
    return Loss(GEMAN_MCCLURE, threshold * threshold, np.inf, 1.0, (scale * threshold) ** -2)


@kernel
def squared_sampson_distance(f: FloatArray, x1: float, y1: float, x2: float, y2: float) -> float:
    """Return the squared Sampson distance (thesis 4.2) of one match."""
    ax, ay, az = f[0] * x1 + f[1] * y1 + f[2], f[3] * x1 + f[4] * y1 + f[5], f[6] * x1 + f[7] * y1 + f[8]
    bx, by = f[0] * x2 + f[3] * y2 + f[6], f[1] * x2 + f[4] * y2 + f[7]
    algebraic = x2 * ax + y2 * ay + az
    gradient = ax * ax + ay * ay + bx * bx + by * by
    return algebraic * algebraic / gradient if gradient > 0.0 else np.inf


@kernel
def squared_distances(points: FloatArray, f: FloatArray) -> FloatArray:
    """Return (N,) squared Sampson distances of all matches."""
    squared = np.empty(points.shape[0])
    fill_squared_distances(points, f, FIRST, squared)
    return squared


@kernel
def fill_squared_distances(points: FloatArray, f: FloatArray, start: int, squared: FloatArray) -> None:
    """Write the squared Sampson distances of the matches from row `start` on to `squared` (n,)."""
    f0, f1, f2, f3, f4, f5, f6, f7, f8 = f[0], f[1], f[2], f[3], f[4], f[5], f[6], f[7], f[8]
    for i in range(squared.shape[0]):  # scalars, so that the compiler vectorizes over matches
        x1, y1, x2, y2 = points[start + i, 0], points[start + i, 1], points[start + i, 2], points[start + i, 3]
        ax, ay, az = f0 * x1 + f1 * y1 + f2, f3 * x1 + f4 * y1 + f5, f6 * x1 + f7 * y1 + f8
        bx, by = f0 * x2 + f3 * y2 + f6, f1 * x2 + f4 * y2 + f7
        algebraic = x2 * ax + y2 * ay + az
        gradient = ax * ax + ay * ay + bx * bx + by * by
        squared[i] = algebraic * algebraic / gradient if gradient > 0.0 else np.inf


@kernel
def _cost(loss: Loss, squared: float) -> float:
    if loss.kind == GEMAN_MCCLURE:
        return 1.0 - 1.0 / (1.0 + loss.precision * squared)
    if not squared <= loss.reach:
        return loss.worst
    if loss.kind == MSAC:
        return squared
    if loss.kind == RANSAC:
        return 0.0
    if loss.kind == MSAC_LINEAR:
        return float(np.sqrt(squared))
    return float(np.log((1.0 + loss.odds) / (np.exp(-loss.precision * squared) + loss.odds)))


@kernel
def penalty(points: FloatArray, start: int, f: FloatArray, loss: Loss, to_beat: float, pretest: PreTest) -> float:
    """Return the penalty of all matches, or inf as soon as f cannot stay below `to_beat` or fails the pre-test.

    It begins with the match `start`. The points are in random order, repeated to (2 N, 4) for a pre-test with a random
    start. The median has no pre-test.
    """
    if loss.kind == LMEDS:
        return _median_of_squares(points, f, to_beat)
    total, inliers, done = 0.0, 0, 0
    count = points.shape[0] // 2 if pretest.random_start else points.shape[0]
    squared = np.empty(BLOCK)
    while done < count:
        often = pretest.stride < BLOCK and done < pretest.stride * pretest.least_inliers.shape[0]
        size = min(16 if often else BLOCK, count - done)  # for speed: no result depends on it
        fill_squared_distances(points, f, start + done, squared[:size])
        if often:  # the pre-test checks after every few matches, and rejects most models at the first checks
            for i in range(size):
                inliers += squared[i] <= loss.limit
                total += _cost(loss, squared[i])
                if not _check_pretest(pretest, done + i + 1, inliers):
                    return np.inf
        else:
            added, cost = _sum_costs(squared[:size], loss)
            inliers += added
            total += cost
            if not _check_pretest(pretest, done + size, inliers):
                return np.inf
        if total >= to_beat:
            return np.inf
        done += size
    return total


@kernel
def _check_pretest(pretest: PreTest, done: int, inliers: int) -> bool:
    """Return whether a model with this many inliers passes the pre-test; count it if it is rejected."""
    check = done // pretest.stride
    if (
        done % pretest.stride != 0
        or check > pretest.least_inliers.shape[0]
        or inliers >= pretest.least_inliers[check - 1]
    ):
        return True
    pretest.rejected[0] += done
    pretest.rejected[1] += inliers
    return False


@kernel
def _sum_costs(squared: FloatArray, loss: Loss) -> tuple[int, float]:
    total, inliers = 0.0, 0
    for i in range(squared.shape[0]):
        inliers += squared[i] <= loss.limit
    if loss.kind == GEMAN_MCCLURE:  # branch-free, so that the compiler vectorizes
        for i in range(squared.shape[0]):
            total += 1.0 - 1.0 / (1.0 + loss.precision * squared[i])
    else:
        for i in range(squared.shape[0]):
            total += _cost(loss, squared[i])
    return inliers, total


@kernel
def _median_of_squares(points: FloatArray, f: FloatArray, to_beat: float) -> float:
    """Return the (N // 2 + 1)th smallest squared distance, or inf once it cannot be below `to_beat`."""
    count = points.shape[0]
    squared = np.empty(count)
    may_miss = count - count // 2 - 1
    for i in range(count):
        squared[i] = squared_sampson_distance(f, points[i, 0], points[i, 1], points[i, 2], points[i, 3])
        may_miss -= squared[i] >= to_beat
        if may_miss < 0:
            return np.inf
    return float(np.partition(squared, count // 2)[count // 2])


# MLESAC: the likelihood of F under Gaussian inliers and uniform outliers (Torr and Zisserman 2000; thesis 3.5, 4.6).
# The distances of inliers are absolute values of a Gaussian about 0, those of outliers uniform over the window w.
# Each match costs q = log((1 + odds) / (exp(-r^2 / (2 sigma^2)) + odds)), odds = (1 - gamma) / gamma * sigma sqrt(2
# pi) / w, which is -log p(r) of 3.5 minus its value at r = 0: no penalty is negative, so that scoring can stop early.

SIGMAS = 1.96
"""Standard deviations of the inliers in a threshold (thesis 3.3.6)."""


def mlesac(points: FloatArray, threshold: float, best: FloatArray | None) -> Loss:
    """Return the penalty above; gamma is the share of inliers of the best model, one half before there is one."""
    sigma, width = threshold / SIGMAS, outlier_window(points)
    gamma = 0.5 if best is None else inlier_share(squared_distances(points, best), sigma, width)
    odds = (1 - gamma) / gamma * sigma * math.sqrt(2 * math.pi) / width
    reach = -math.log(1e-12 * min(odds, 1.0)) * 2 * sigma * sigma
    return Loss(MLESAC, threshold * threshold, reach, math.log((1 + odds) / odds), 1 / (2 * sigma * sigma), odds)


def outlier_window(points: FloatArray) -> float:
    """Return the range w of an outlier's signed distance: the diagonal of the matches in a view, averaged over both."""
    extent = np.ptp(points, axis=0)
    return max(float(np.hypot(extent[[0, 2]], extent[[1, 3]]).mean()), np.finfo(float).tiny)


def inlier_share(squared: FloatArray, sigma: float, width: float) -> float:
    """Estimate gamma = p(v) by expectation maximization for given sigma and w, within [1 / N, 1 - 1 / N]."""
    inlier = np.exp(-squared / (2 * sigma * sigma)) / (sigma * math.sqrt(2 * math.pi))
    least = 1 / max(len(squared), 2)
    gamma = 0.5
    for _ in range(100):
        before = gamma
        gamma = float(np.mean(gamma * inlier / (gamma * inlier + (1 - gamma) / width)))
        gamma = min(max(gamma, least), 1 - least)
        if abs(gamma - before) < 1e-5:
            break
    return gamma


# RES-RANSAC: priors from the residuals to the best model (thesis 4.6). The validity of a match is the probability of
# an error above its own, p(v | r_i) = 1 - p(0 <= r <= r_i) (4.10). The distribution of r is a histogram times a
# Gaussian (4.13); the thesis prints exp(-r / (2 sigma)), which has a unit: exp(-r^2 / (2 sigma^2)) is meant.

BINS = 100
"""Bins of the histogram, each a hundredth of the median wide (thesis 4.6.1)."""


def residual_validity(points: FloatArray, f: FloatArray, _threshold: float) -> FloatArray:
    """Return p(v_i) of every match from its Sampson distance to the best model."""
    return validity_from_residuals(np.sqrt(squared_distances(points, f)))


def validity_from_residuals(residuals: FloatArray) -> FloatArray:
    """Return p(v_i | r_i) of 4.10 to 4.15, in [0, 1], one > 0; all 1 where one bin holds all residuals.

    The bins are a hundredth of the median wide, and the last one holds all larger residuals: there p(0 <= r <= r_i) is
    1 and p(v) is 0, so that samples come from the better half of the matches only.
    """
    width = float(np.median(residuals)) / BINS
    if not 0 < width < np.inf:  # half of the residuals are 0, or infinite
        return np.asarray(residuals <= residuals.min(), dtype=np.float64)
    bins = np.minimum(np.ceil(residuals / width) - 1, BINS - 1).astype(np.int64).clip(min=0)  # Q_l < r <= Q_l+1
    middles = (np.arange(BINS) + 0.5) * width
    finite = residuals[np.isfinite(residuals)]
    # over all errors, as in the thesis: outliers make it large, so that the histogram dominates
    variance = float(np.mean(finite**2))
    mass = np.bincount(bins, minlength=BINS) * np.exp(-(middles**2) / (2 * variance))
    valid = 1 - np.minimum(np.cumsum(mass / mass.sum()), 1.0)
    valid[-1] = 0.0
    validity = valid[bins]
    return validity if validity.any() else np.ones(len(residuals))
