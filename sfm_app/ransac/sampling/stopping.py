"""When to stop drawing samples (thesis 3.3.6, 4.4.5 and 4.7.4)."""

import math

import numpy as np
from numpy.typing import NDArray

CONVERGED = 0.05
"""G of the thesis (4.7.4, Eq. 4.18): priors have converged when the sum of their changes is below this."""


def required_trials(success: float, confidence: float, log_missed: float = 0.0) -> float:
    """Return how many samples make one success as probable as wanted (thesis 3.19); inf if none can succeed.

    Args:
        success: probability that one sample is clean, share^m, and that its model passes the test.
        confidence: wanted probability, in (0, 1).
        log_missed: logarithm of the probability that all samples drawn before failed; they are not counted again.
    """
    left = math.log1p(-confidence) - log_missed
    if left >= 0:
        return 0.0
    if success >= 1:
        return 1.0
    return left / math.log1p(-success) if success > 0 else math.inf


def has_converged(before: NDArray[np.float64], after: NDArray[np.float64], limit: float = CONVERGED) -> bool:
    """Return whether the priors, normalized to sum 1, changed less than a limit in sum (thesis 4.18).

    The printed sum grows with the number of matches; for probabilities that sum to 1 it lies in [0, 2].

    Args:
        before: (N,) priors >= 0, of any sum but zero.
        after: (N,) the new priors.
        limit: of the sum of the changes, in [0, 2].
    """
    return bool(np.abs(after / after.sum() - before / before.sum()).sum() < limit)
