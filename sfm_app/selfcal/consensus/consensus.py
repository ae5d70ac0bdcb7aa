"""The consensus of all pairs over all of K at once.

Thesis (5.33) seeks the point where most zero curves meet, in one plane of K at a time. Here all of K is searched at
once: at the parameters ``theta = (log f, u, v, log a)``, with f = sqrt(fx fy) and a = fy / fx, how many pairs satisfy
the constraint? Each pair votes with at most its weight, so that outliers have little influence::

    support(theta) = sum_i w_i exp(-r_i(theta) / sigma),      r = (s1 - s2) / (s1 + s2) of E_i = K'F_iK

A vote is taken as a log-likelihood, to which a log-prior on the center is added: the prior decides where pairs are few
and fades where they are many.
"""

from collections.abc import Sequence

import numpy as np

from sfm_app.jit import kernel
from sfm_app.selfcal.constraints import singular_value_ratio
from sfm_app.selfcal.inputs import FloatArray, Pairs

LOG_FOCAL, CENTER_U, CENTER_V, LOG_ASPECT = range(4)
"""Places in theta."""
FIRST_STEPS = np.array([0.05, 0.03, 0.03, 0.05])
"""First steps of the local search along theta. Chosen by hand; halved and doubled by `benchmarks.sensitivity`."""
FINISHED_STEP, FINISHED_VALUE = 1e-5, 1e-6
"""A simplex of this extent in theta and in value has converged. Chosen by hand; halved and doubled by
`benchmarks.sensitivity`."""
MOST_STEPS = 300
"""Most steps of a simplex. Chosen by hand; halved and doubled by `benchmarks.sensitivity`."""


class Consensus:
    """The function that the right K maximizes.

    Args:
        pairs: the pairs that vote.
        center_sigma: standard deviation of the prior on (u, v) about (0, 0), in units of the pairs; may be inf.
        weights: (P,) to use instead of those of the pairs.
    """

    def __init__(self, pairs: Pairs, center_sigma: float, weights: FloatArray | None = None) -> None:
        self.pairs = pairs
        self.center_sigma = center_sigma
        self.weights = pairs.weights if weights is None else weights
        self._packed = pairs.packed_rows

    def with_weights(self, weights: FloatArray) -> "Consensus":
        """Return the consensus of the same pairs with other weights (P,)."""
        return Consensus(self.pairs, self.center_sigma, weights)

    def evaluate(self, thetas: FloatArray, sigma: float) -> FloatArray:
        """Return (N,) supports plus log-priors at `thetas`.

        Args:
            thetas: (N, 4) parameters of K.
            sigma: width of a vote, in units of r, > 0.
        """
        return np.asarray(_values(self._packed, self.weights, self.center_sigma, thetas, sigma))

    def ratios(self, theta: FloatArray) -> FloatArray:
        """Return (P,) r_i at theta."""
        return np.asarray(_ratios(self._packed, theta))

    def climb(self, start: FloatArray, free: Sequence[int], sigmas: Sequence[float]) -> tuple[FloatArray, float]:
        """Return the local maximum reached from a start by moving some entries of theta, through falling sigmas.

        Nelder-Mead, because the consensus has a cusp wherever a pair is satisfied exactly. For every sigma it runs a
        second time, from the end of the first with a tenth of its steps: a simplex can stall on a ridge.

        Args:
            start: (4,) theta to begin at.
            free: places in theta that may move.
            sigmas: falling widths of a vote, at least one.

        Returns:
            theta (4,) and the value there, at the last sigma.
        """
        theta, value = start.copy(), 0.0
        for sigma in sigmas:
            for steps in (FIRST_STEPS, 0.1 * FIRST_STEPS):
                simplex = np.tile(theta, (len(free) + 1, 1))
                for row, index in enumerate(free):
                    simplex[row + 1, index] += steps[index]
                theta, value = _climb(self._packed, self.weights, self.center_sigma, simplex, sigma)
        return theta, value


@kernel
def _ratios(packed: FloatArray, theta: FloatArray) -> FloatArray:
    fx, fy = np.exp(theta[0] - 0.5 * theta[3]), np.exp(theta[0] + 0.5 * theta[3])
    r = np.empty(len(packed))
    for i in range(len(packed)):
        r[i] = singular_value_ratio(packed[i], fx, fy, theta[1], theta[2])
    return r


@kernel
def _value(packed: FloatArray, weights: FloatArray, center_sigma: float, theta: FloatArray, sigma: float) -> float:
    """Return sum_i w_i exp(-r_i / sigma) plus the log-prior of the center."""
    fx, fy = np.exp(theta[0] - 0.5 * theta[3]), np.exp(theta[0] + 0.5 * theta[3])
    value = -0.5 * (theta[1] ** 2 + theta[2] ** 2) / center_sigma**2
    for i in range(len(packed)):
        value += weights[i] * np.exp(-singular_value_ratio(packed[i], fx, fy, theta[1], theta[2]) / sigma)
    return float(value)


@kernel
def _values(
    packed: FloatArray, weights: FloatArray, center_sigma: float, thetas: FloatArray, sigma: float
) -> FloatArray:
    values = np.empty(len(thetas))
    for k in range(len(thetas)):
        values[k] = _value(packed, weights, center_sigma, thetas[k], sigma)
    return values


@kernel
def _climb(
    packed: FloatArray, weights: FloatArray, center_sigma: float, simplex: FloatArray, sigma: float
) -> tuple[FloatArray, float]:
    """Find a maximum by Nelder and Mead (1965) from a simplex (n + 1, 4), with their coefficients 1, 2, 1/2, 1/2."""
    count = len(simplex)
    values = _values(packed, weights, center_sigma, simplex, sigma)
    for _ in range(MOST_STEPS):
        _sort(simplex, values)
        if values[0] - values[-1] <= FINISHED_VALUE and _extent(simplex) <= FINISHED_STEP:
            break
        worst = values[-1]
        trial = _reflect(simplex, 1.0)
        value = _value(packed, weights, center_sigma, trial, sigma)
        if value > values[0]:
            further = _reflect(simplex, 2.0)
            better = _value(packed, weights, center_sigma, further, sigma)
            if better > value:
                trial, value = further, better
        elif value <= values[-2]:
            floor = max(value, worst)
            trial = _reflect(simplex, 0.5 if value > worst else -0.5)
            value = _value(packed, weights, center_sigma, trial, sigma)
            if value <= floor:
                for k in range(1, count):
                    for column in range(4):
                        simplex[k, column] = 0.5 * (simplex[0, column] + simplex[k, column])
                    values[k] = _value(packed, weights, center_sigma, simplex[k], sigma)
                continue
        _copy(trial, simplex[-1])
        values[-1] = value
    _sort(simplex, values)
    return simplex[0].copy(), float(values[0])


@kernel
def _sort(simplex: FloatArray, values: FloatArray) -> None:
    """Sort in place, highest first; equal values keep their order. Loops compile in a tenth of the time of argsort."""
    for k in range(1, len(values)):
        row, value = simplex[k].copy(), values[k]
        i = k
        while i > 0 and values[i - 1] < value:
            _copy(simplex[i - 1], simplex[i])
            values[i] = values[i - 1]
            i -= 1
        _copy(row, simplex[i])
        values[i] = value


@kernel
def _copy(row: FloatArray, place: FloatArray) -> None:
    """Write the entries of a row to a place; assigning rows compiles for a second and a half."""
    for column in range(4):
        place[column] = row[column]


@kernel
def _reflect(simplex: FloatArray, factor: float) -> FloatArray:
    """Return the last corner reflected at the centroid of the others, its distance scaled by `factor`."""
    trial = np.empty(4)
    for column in range(4):
        middle = 0.0
        for k in range(len(simplex) - 1):
            middle += simplex[k, column]
        middle /= len(simplex) - 1
        trial[column] = middle + factor * (middle - simplex[-1, column])
    return trial


@kernel
def _extent(simplex: FloatArray) -> float:
    extent = 0.0
    for k in range(1, len(simplex)):
        for column in range(4):
            extent = max(extent, abs(simplex[k, column] - simplex[0, column]))
    return extent
