"""When to stop drawing samples (thesis 3.3.6, 4.4.5 and 4.7.4)."""

import math

import numpy as np
from numpy.typing import NDArray

from sfm_app.ransac.sampling import SAMPLE_SIZE

CONVERGED = 0.05
"""G of the thesis: priors that changed less than this, in sum, have converged."""


def trials_needed(inlier_share: float, confidence: float, sample_size: int = SAMPLE_SIZE) -> float:
    """Samples that hold one without outliers with the wanted probability (thesis 3.19); inf for no inliers."""
    clean = inlier_share**sample_size
    if clean >= 1:
        return 1.0
    return math.log1p(-confidence) / math.log1p(-clean) if clean > 0 else math.inf


def have_converged(before: NDArray[np.float64], after: NDArray[np.float64], limit: float = CONVERGED) -> bool:
    """Whether the priors, each normalised to sum 1, moved less than `limit` in sum (thesis 4.18).

    The printed sum grows with the number of matches; as probabilities that sum to 1 it lies in [0, 2] for any number.
    """
    return bool(np.abs(after / after.sum() - before / before.sum()).sum() < limit)
