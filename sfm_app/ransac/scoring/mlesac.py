"""MLESAC: the likelihood of F under Gaussian inliers and uniform outliers (Torr and Zisserman 2000; thesis 3.5, 4.6).

The distances of inliers are taken as the absolute values of a Gaussian about 0, those of outliers as uniform over the
window w. Each match costs::

    q = log((1 + odds) / (exp(-r^2 / (2 sigma^2)) + odds)),    odds = (1 - gamma) / gamma * sigma sqrt(2 pi) / w

which is -log p(r) of 3.5 minus its value at r = 0: no penalty is negative, so that scoring can stop early.
"""

import math

import numpy as np
from numpy.typing import NDArray

from sfm_app.ransac.scoring.robust_costs import MLESAC, Loss, squared_distances

FloatArray = NDArray[np.float64]

SIGMAS = 1.96
"""Standard deviations of the inliers in a threshold (thesis 3.3.6)."""
_NEGLIGIBLE = 1e-12
"""Density of an inlier, relative to that of the outliers, below which a match costs as much as an outlier. Chosen by
hand; not measured on its own."""
_MOST_STEPS = 100
"""Largest number of steps of expectation maximization. Chosen by hand; not measured on its own."""
_GAMMA_TOLERANCE = 1e-5
"""Change of gamma that ends expectation maximization. Chosen by hand; not measured on its own."""


def mlesac(points: FloatArray, threshold: float, best: FloatArray | None) -> Loss:
    """Return the penalty above; gamma is the share of inliers of the best model, one half before there is one.

    Args:
        points: (N, 4) matches.
        threshold: largest distance of an inlier, in the units of the points.
        best: (9,) entries of the best model; None before there is one.
    """
    sigma, width = threshold / SIGMAS, outlier_window(points)
    gamma = 0.5 if best is None else inlier_share(squared_distances(points, best), sigma, width)
    odds = (1 - gamma) / gamma * sigma * math.sqrt(2 * math.pi) / width
    reach = -math.log(_NEGLIGIBLE * min(odds, 1.0)) * 2 * sigma * sigma
    return Loss(MLESAC, threshold * threshold, reach, math.log((1 + odds) / odds), 1 / (2 * sigma * sigma), odds)


def outlier_window(points: FloatArray) -> float:
    """Return the range w of an outlier's signed distance: the diagonal of the matches in a view, averaged over both."""
    extent = np.ptp(points, axis=0)
    return max(float(np.hypot(extent[[0, 2]], extent[[1, 3]]).mean()), np.finfo(float).tiny)


def inlier_share(squared: FloatArray, sigma: float, width: float) -> float:
    """Estimate gamma = p(v) of the mixture by expectation maximization, for given sigma and w.

    Args:
        squared: (N,) squared distances to the model.
        sigma: standard deviation of the inliers.
        width: range of the outliers.

    Returns:
        Within [1 / N, 1 - 1 / N]: a share of 0 or 1 would make some distances impossible.
    """
    inlier = np.exp(-squared / (2 * sigma * sigma)) / (sigma * math.sqrt(2 * math.pi))
    least = 1 / max(len(squared), 2)
    gamma = 0.5
    for _ in range(_MOST_STEPS):
        before = gamma
        gamma = float(np.mean(gamma * inlier / (gamma * inlier + (1 - gamma) / width)))
        gamma = min(max(gamma, least), 1 - least)
        if abs(gamma - before) < _GAMMA_TOLERANCE:
            break
    return gamma
