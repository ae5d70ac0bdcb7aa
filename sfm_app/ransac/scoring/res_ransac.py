"""RES-RANSAC: priors from the residuals to the best model (thesis 4.6).

The validity of a match is the probability of an error above its own, p(v | r_i) = 1 - p(0 <= r <= r_i) (4.10). The
distribution of r is a histogram times a Gaussian (4.13); the thesis prints exp(-r / (2 sigma)), which is not a Gaussian
and not free of units: exp(-r^2 / (2 sigma^2)) is meant.
"""

import numpy as np
from numpy.typing import NDArray

from sfm_app.ransac.scoring.robust_costs import squared_distances

FloatArray = NDArray[np.float64]

BINS = 100
"""Bins of the histogram, each a hundredth of the median wide (thesis 4.6.1)."""


def residual_validity(points: FloatArray, f: FloatArray, _threshold: float) -> FloatArray:
    """Return p(v_i) of every match from its Sampson distance to the best model.

    Args:
        points: (N, 4) matches.
        f: (9,) entries of F by rows.
        _threshold: not used; all such functions take it.
    """
    return validity_from_residuals(np.sqrt(squared_distances(points, f)))


def validity_from_residuals(residuals: FloatArray) -> FloatArray:
    """Return p(v_i | r_i) of 4.10 to 4.15.

    The bins are a hundredth of the median wide, and the last one holds all larger residuals: there p(0 <= r <= r_i) is
    1 and p(v) is 0, so that samples come from the better half of the matches only.

    Args:
        residuals: (N,) distances >= 0.

    Returns:
        (N,) in [0, 1], at least one of them > 0; all 1 where one bin holds all residuals.
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
    chosen = valid[bins]
    return chosen if chosen.any() else np.ones(len(residuals))
