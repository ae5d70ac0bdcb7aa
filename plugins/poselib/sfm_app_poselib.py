"""PoseLib's LO-RANSAC for fundamental matrices, as a plug-in of sfm-app.

PoseLib compares the Sampson distance with `max_epipolar_error`, as sfm-app does, and ends with a fit to all inliers by
their Sampson distances, Cauchy-weighted at 1 px. It draws at least the number of samples that PoseLib sets by default,
unless `max_trials` is less.
"""

from collections.abc import Iterable

import numpy as np
import poselib
from numpy.typing import NDArray

from sfm_app.fundamental.estimate import estimate_with
from sfm_app.plugins import Estimator, hookimpl
from sfm_app.settings import EpipolarSettings
from sfm_app.types import EpipolarFit, Rejected

FloatArray = NDArray[np.float64]

LEAST_TRIALS = 1000


def fit_poselib(x1: FloatArray, x2: FloatArray, options: EpipolarSettings, seed: int) -> EpipolarFit | Rejected:
    """Run LO-RANSAC (Larsson and contributors, PoseLib)."""
    return estimate_with(_find, x1, x2, options, seed)


def _find(x1: FloatArray, x2: FloatArray, options: EpipolarSettings, seed: int) -> tuple[FloatArray, int] | None:
    ransac = {
        "max_epipolar_error": options.max_error_px,
        "success_prob": options.confidence,
        "max_iterations": options.max_trials,
        "min_iterations": min(LEAST_TRIALS, options.max_trials),
        "seed": seed % 2**31,
    }
    F, found = poselib.estimate_fundamental(x1, x2, ransac, {})
    return (F, found["iterations"]) if found["num_inliers"] else None


@hookimpl
def sfm_estimators() -> Iterable[Estimator]:
    return [Estimator("poselib", fit_poselib, "PoseLib's LO-RANSAC")]
