"""Random minimal samples, uniform or by weight, from a generator whose state is an argument.

The generator is splitmix64 (Steele, Lea and Flood 2014): 64 bits of state, one multiplication chain per number. Its
state is an argument, so that pairs can run in parallel threads and still give the same bits.
"""

import numpy as np
from numpy.typing import NDArray

from sfm_app.jit import kernel

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
RandomState = NDArray[np.uint64]

SAMPLE_SIZE = 7
"""Matches of a minimal sample: F has seven degrees of freedom (thesis 4.3.1)."""

_STEP = np.uint64(0x9E3779B97F4A7C15)
"""Increment of the state of splitmix64: 2^64 over the golden ratio (Steele, Lea and Flood 2014)."""
_MIX1 = np.uint64(0xBF58476D1CE4E5B9)
"""First multiplier of splitmix64 (Steele, Lea and Flood 2014)."""
_MIX2 = np.uint64(0x94D049BB133111EB)
"""Second multiplier of splitmix64 (Steele, Lea and Flood 2014)."""
_S30, _S27, _S31, _S11 = np.uint64(30), np.uint64(27), np.uint64(31), np.uint64(11)
"""Shifts of splitmix64 (Steele, Lea and Flood 2014), and the last one, which leaves the 53 bits of a double."""
_TO_UNIT = 2.0**-53
"""From 53 random bits to [0, 1) in double precision."""
_MOST_REDRAWS = 100
"""Repeated draws of matches that the sample already holds, before the weights are given up. Chosen by hand; not
measured on its own."""


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
    return float((z ^ (z >> _S31)) >> _S11) * _TO_UNIT


@kernel
def draw_uniform(state: RandomState, count: int, sample: IntArray) -> None:
    """Fill a sample with distinct indices.

    Args:
        state: of the generator; it is advanced.
        count: indices lie below it; at least the sample's length.
        sample: (m,), written to.
    """
    for k in range(sample.shape[0]):
        fresh = False
        while not fresh:
            sample[k] = int(uniform(state) * count)
            fresh = _is_fresh(sample, k)


@kernel
def draw_weighted(state: RandomState, cumulative: FloatArray, sample: IntArray) -> bool:
    """Fill `sample` with distinct indices, each draw proportional to the weights of those that are left.

    Drawing again when an index is already in the sample is the same as drawing from the others. Returns False when this
    does not end, because fewer points than the sample needs hold nearly all the weight.

    Args:
        state: generator.
        cumulative: (N,) running sum of weights >= 0, the last one > 0.
        sample: (m,) filled with indices.
    """
    total = cumulative[-1]
    redraws = 0
    for k in range(sample.shape[0]):
        fresh = False
        while not fresh:
            sample[k] = _search_sorted(cumulative, uniform(state) * total)
            fresh = _is_fresh(sample, k)
            redraws += not fresh
            if redraws > _MOST_REDRAWS:
                return False
    return True


@kernel
def _is_fresh(sample: IntArray, last: int) -> bool:
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
