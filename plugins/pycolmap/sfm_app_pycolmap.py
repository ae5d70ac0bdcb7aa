"""COLMAP's LO-RANSAC for fundamental matrices, as a plug-in of sfm-app.

COLMAP compares the Sampson distance with `max_error`, as sfm-app does. It draws at least the number of samples that
COLMAP sets by default, unless `max_trials` is less. It does not report how many it drew: `EpipolarFit.trials` is the
largest possible number.
"""

import zlib  # noqa: F401 - before pycolmap, whose bundled deflate breaks Python's if it is loaded first
from collections.abc import Iterable

import numpy as np
import pycolmap
from numpy.typing import NDArray

from sfm_app.fundamental.estimate import estimate_with
from sfm_app.plugins import Estimator, hookimpl
from sfm_app.settings import EpipolarSettings
from sfm_app.types import EpipolarFit, Rejected

FloatArray = NDArray[np.float64]


def fit_loransac(x1: FloatArray, x2: FloatArray, options: EpipolarSettings, seed: int) -> EpipolarFit | Rejected:
    """Run LO-RANSAC (Chum, Matas and Kittler 2003) as implemented in COLMAP."""
    return estimate_with(_find, x1, x2, options, seed)


def _find(x1: FloatArray, x2: FloatArray, options: EpipolarSettings, seed: int) -> tuple[FloatArray, int] | None:
    ransac = pycolmap.RANSACOptions()
    ransac.max_error = options.max_error_px
    ransac.confidence = options.confidence
    ransac.max_num_trials = options.max_trials
    ransac.min_num_trials = min(ransac.min_num_trials, options.max_trials)
    ransac.random_seed = seed % 2**31
    ransac.num_threads = 1
    found = pycolmap.estimate_fundamental_matrix(x1, x2, ransac)
    return None if found is None else (found["F"], options.max_trials)


@hookimpl
def sfm_estimators() -> Iterable[Estimator]:
    return [Estimator("pycolmap-loransac", fit_loransac, "COLMAP's LO-RANSAC")]
