"""Minimal samples, and when to stop drawing them (thesis 3.3.6, 4.4.5 and 4.7.4)."""

import math

import numpy as np
from numpy.typing import NDArray

from sfm_app.jit import kernel
from sfm_app.types.arrays import FloatArray, IndexArray

# Minimal samples, uniform or by weight. The generator is splitmix64 (Steele, Lea and Flood 2014). Its state is an
# argument, so that pairs can run in parallel threads and still give the same bits.

RandomState = NDArray[np.uint64]

SAMPLE_SIZE = 7
"""Matches of a minimal sample: F has seven degrees of freedom (thesis 4.3.1)."""

_STEP = np.uint64(0x9E3779B97F4A7C15)
"""Increment of the state: 2^64 over the golden ratio (Steele, Lea and Flood 2014)."""
_MIX1, _MIX2 = np.uint64(0xBF58476D1CE4E5B9), np.uint64(0x94D049BB133111EB)
"""Multipliers of splitmix64 (Steele, Lea and Flood 2014)."""
_S30, _S27, _S31, _S11 = np.uint64(30), np.uint64(27), np.uint64(31), np.uint64(11)
"""Shifts of splitmix64 (Steele, Lea and Flood 2014), and the one that leaves the 53 bits of a double."""


def random_state(seed: int) -> RandomState:
    """Return the (1,) state of the generator for any integer seed."""
    return np.array([seed % 2**64], dtype=np.uint64)


@kernel
def uniform(state: RandomState) -> float:
    """Return the next number in [0, 1)."""
    state[0] += _STEP
    z = state[0]
    z = (z ^ (z >> _S30)) * _MIX1
    z = (z ^ (z >> _S27)) * _MIX2
    return float((z ^ (z >> _S31)) >> _S11) * 2.0**-53


@kernel
def draw_uniform(state: RandomState, count: int, sample: IndexArray) -> None:
    """Fill a sample (m,) with distinct indices below `count`, which is at least m."""
    for k in range(sample.shape[0]):
        fresh = False
        while not fresh:
            sample[k] = int(uniform(state) * count)
            fresh = _is_fresh(sample, k)


@kernel
def draw_weighted(state: RandomState, cumulative: FloatArray, sample: IndexArray) -> bool:
    """Fill a sample (m,) with distinct indices, each draw proportional to the weights of the remaining ones.

    `cumulative` (N,) is the running sum of weights >= 0. Repeated indices are drawn again; False after 100 repetitions,
    because fewer points than the sample needs hold nearly all the weight.
    """
    total = cumulative[-1]
    redraws = 0
    for k in range(sample.shape[0]):
        fresh = False
        while not fresh:
            sample[k] = _search_sorted(cumulative, uniform(state) * total)
            fresh = _is_fresh(sample, k)
            redraws += not fresh
            if redraws > 100:
                return False
    return True


@kernel
def _is_fresh(sample: IndexArray, last: int) -> bool:
    equal = 0
    for k in range(last):
        equal += sample[k] == sample[last]
    return equal == 0


@kernel
def _search_sorted(cumulative: FloatArray, target: float) -> int:
    low, high = 0, cumulative.shape[0] - 1
    while low < high:
        middle = (low + high) // 2
        if cumulative[middle] > target:
            high = middle
        else:
            low = middle + 1
    return low


CONVERGED = 0.05
"""G of the thesis (4.7.4, Eq. 4.18): priors have converged when the sum of their changes is below this."""


def required_trials(success: float, confidence: float, log_missed: float = 0.0) -> float:
    """Return how many samples reach a success with probability `confidence` (thesis 3.19); inf if none can succeed.

    `success` is the probability that one sample is clean and its model passes the test, `log_missed` the logarithm of
    the probability that all earlier samples failed.
    """
    remaining = math.log1p(-confidence) - log_missed
    if remaining >= 0:
        return 0.0
    if success >= 1:
        return 1.0
    return remaining / math.log1p(-success) if success > 0 else math.inf


def has_converged(before: FloatArray, after: FloatArray, limit: float = CONVERGED) -> bool:
    """Return whether the priors (N,), of sum 1, changed by less than `limit` in sum, in [0, 2] (thesis 4.18)."""
    return bool(np.abs(after / after.sum() - before / before.sum()).sum() < limit)
