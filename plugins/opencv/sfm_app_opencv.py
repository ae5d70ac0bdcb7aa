"""OpenCV's estimators of the fundamental matrix, as a plug-in of sfm-app.

How OpenCV interprets the settings, checked with OpenCV 5.0:

- USAC compares the Sampson distance with the threshold, as sfm-app does. `opencv-ransac` compares the larger of the two
  distances from a point to its epipolar line, at least sqrt(2) times as large; its threshold is multiplied by sqrt(2).
- MAGSAC marginalizes over noise up to its own limit: the threshold has little effect on the search.
- Random states are fixed inside OpenCV; the seed only changes the order of the matches.
- OpenCV does not report how many samples it drew: `EpipolarFit.trials` is the largest possible number.
- `opencv-ransac` returns its best seven-point model without a fit to the inliers.
"""

from collections.abc import Iterable
from functools import partial

import cv2
import numpy as np
from numpy.typing import NDArray

from sfm_app.fundamental.estimate import estimate_with
from sfm_app.plugins import Estimator, hookimpl
from sfm_app.settings import EpipolarSettings
from sfm_app.types import EpipolarFit, Rejected

FloatArray = NDArray[np.float64]


def fit_magsac(x1: FloatArray, x2: FloatArray, options: EpipolarSettings, seed: int) -> EpipolarFit | Rejected:
    """Run MAGSAC++ (Barath, Noskova, Ivashechkin and Matas 2020)."""
    return estimate_with(partial(_find, cv2.USAC_MAGSAC), x1, x2, options, seed)


def fit_usac(x1: FloatArray, x2: FloatArray, options: EpipolarSettings, seed: int) -> EpipolarFit | Rejected:
    """Run USAC (Raguram, Chum, Pollefeys, Matas and Frahm 2013) with OpenCV's default parts."""
    return estimate_with(partial(_find, cv2.USAC_DEFAULT), x1, x2, options, seed)


def fit_usac_accurate(x1: FloatArray, x2: FloatArray, options: EpipolarSettings, seed: int) -> EpipolarFit | Rejected:
    """Run USAC with graph-cut local optimization (Barath and Matas 2018)."""
    return estimate_with(partial(_find, cv2.USAC_ACCURATE), x1, x2, options, seed)


def fit_ransac(x1: FloatArray, x2: FloatArray, options: EpipolarSettings, seed: int) -> EpipolarFit | Rejected:
    """Run RANSAC (Fischler and Bolles 1981)."""
    return estimate_with(partial(_find, cv2.FM_RANSAC), x1, x2, options, seed)


def _find(
    method: int, x1: FloatArray, x2: FloatArray, options: EpipolarSettings, _: int
) -> tuple[FloatArray, int] | None:
    threshold = options.max_error_px * (np.sqrt(2) if method == cv2.FM_RANSAC else 1)
    try:
        F, _mask = cv2.findFundamentalMat(x1, x2, method, threshold, options.confidence, options.max_trials)
    except cv2.error:  # raised where no sample gives a model
        return None
    return None if F is None or F.shape != (3, 3) else (F, options.max_trials)


@hookimpl
def sfm_estimators() -> Iterable[Estimator]:
    return [
        Estimator("opencv-magsac", fit_magsac, "OpenCV's MAGSAC++"),
        Estimator("opencv-usac", fit_usac, "OpenCV's USAC with its default parts"),
        Estimator("opencv-usac-accurate", fit_usac_accurate, "OpenCV's USAC with graph-cut local optimization"),
        Estimator("opencv-ransac", fit_ransac, "OpenCV's RANSAC, its best sample without a refit"),
    ]
