"""The final fit: the estimator's own, optionally followed by one that the settings name (thesis 4.3).

The three named fits are least squares on the inliers of the given model. One minimizes the algebraic distance; the
other two start from its result and minimize the Sampson or the reprojection distance. With fewer than eight inliers the
model does not change.
"""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from sfm_app.ransac.refine.gold_standard import refine_reprojection
from sfm_app.ransac.refine.sampson_refit import fit_eight_point, refine_sampson
from sfm_app.ransac.scoring.robust_costs import squared_distances

FloatArray = NDArray[np.float64]
Refit = Callable[[FloatArray, FloatArray, float], FloatArray]
"""(points, F, threshold) -> the final F."""


def _refit_eight_point(points: FloatArray, F: FloatArray, threshold: float) -> FloatArray:
    """Apply the 8-point algorithm (thesis 4.3.2)."""
    inliers = _inliers(points, F, threshold)
    return F if len(inliers) < 8 else fit_eight_point(inliers, np.ones(len(inliers)))


def refit_sampson(points: FloatArray, F: FloatArray, threshold: float) -> FloatArray:
    """Minimize the Sampson distance (thesis 4.2).

    Args:
        points: (N, 4) matches.
        F: (3, 3) the model to start from.
        threshold: largest distance of an inlier, in the units of the points.
    """
    inliers = _inliers(points, F, threshold)
    return refine_sampson(inliers, _refit_eight_point(points, F, threshold)) if len(inliers) >= 8 else F


def _refit_reprojection(points: FloatArray, F: FloatArray, threshold: float) -> FloatArray:
    """Minimize the reprojection distance (thesis 4.3), starting from the minimum of the Sampson distance."""
    inliers = _inliers(points, F, threshold)
    return F if len(inliers) < 8 else refine_reprojection(inliers, refit_sampson(points, F, threshold))


REFITS: dict[str, Refit] = {
    "eight-point": _refit_eight_point,
    "sampson": refit_sampson,
    "reprojection": _refit_reprojection,
}
"""Values of `EpipolarSettings.refit` besides "auto"."""


def choose_refit(name: str, own: Refit) -> Refit:
    """Return the estimator's own fit, followed by the named fit to its inliers unless the name is "auto".

    The own fit always comes first: its inliers are better than those of the best sample.

    Args:
        name: "auto", or a name in `REFITS`.
        own: the estimator's own fit.
    """
    if name == "auto":
        return own
    return lambda points, F, threshold: REFITS[name](points, own(points, F, threshold), threshold)


def _inliers(points: FloatArray, F: FloatArray, threshold: float) -> FloatArray:
    chosen = squared_distances(points, np.ascontiguousarray(F).reshape(9)) <= threshold * threshold
    return np.asfortranarray(points[chosen])
