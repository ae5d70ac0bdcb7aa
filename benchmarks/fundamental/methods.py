"""The estimators that are compared: ours by name through the public API, and the rivals called directly."""

import sys
from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

import sfm_app
from benchmarks.common.command_line import import_rival
from benchmarks.common.timing import Method
from sfm_app.colmap.backend import pycolmap
from sfm_app.plugins import load_plugins
from sfm_app.settings import EpipolarSettings, Settings
from sfm_app.types import EpipolarFit

FloatArray = NDArray[np.float64]

BASELINE = "OpenCV MAGSAC++"
"""The rival that times are divided by."""
RIVALS = ("OpenCV RANSAC", BASELINE, "PoseLib", "pycolmap LO-RANSAC", "SupeRANSAC", "openmvg-rs")
QUICK = RIVALS[:-2]
"""Rivals that run unless others are named: the others are in the extra `bench`, and SupeRANSAC takes seconds."""


def our_estimators(names: Sequence[str], options: EpipolarSettings) -> dict[str, Method]:
    """Return estimators of sfm_app by name; unknown ones are skipped with a note, so older versions can be measured."""
    known = load_plugins().estimators
    if missing := [name for name in names if name not in known]:
        print(f"left out, no such estimator: {', '.join(missing)}", file=sys.stderr)
    return {name: _our_estimator(name, options) for name in names if name in known}


def _our_estimator(name: str, options: EpipolarSettings) -> Method:
    settings = Settings(epipolar=options)

    def fit(x1: FloatArray, x2: FloatArray, seed: int) -> tuple[FloatArray | None, int | None]:
        found = sfm_app.estimate_fundamental(x1, x2, method=name, seed=seed, settings=settings)
        return (found.F, found.trials) if isinstance(found, EpipolarFit) else (None, None)

    return fit


def rivals(names: Sequence[str], options: EpipolarSettings) -> dict[str, Method]:
    """Return rivals by name, with our threshold, confidence and limit; what they return is not judged any further."""
    cv2.setNumThreads(1)
    makers = (_opencv(cv2.FM_RANSAC), _opencv(cv2.USAC_MAGSAC), _poselib, _pycolmap, _superansac, _openmvg)
    return {name: make(options) for name, make in zip(RIVALS, makers, strict=True) if name in names}


def _opencv(flag: int) -> Any:
    def make(options: EpipolarSettings) -> Method:
        limits = (options.max_error_px, options.confidence, options.max_trials)
        return lambda x1, x2, seed: (cv2.findFundamentalMat(x1, x2, flag, *limits)[0], None)  # noqa: ARG005

    return make


def _poselib(options: EpipolarSettings) -> Method:
    poselib = import_rival("poselib")
    limits = {
        "max_epipolar_error": options.max_error_px,
        "success_prob": options.confidence,
        "max_iterations": options.max_trials,
    }

    def fit(x1: FloatArray, x2: FloatArray, seed: int) -> tuple[FloatArray | None, int | None]:
        F, report = poselib.estimate_fundamental(x1, x2, {**limits, "seed": seed}, {})
        return F, report["iterations"]

    return fit


def _pycolmap(options: EpipolarSettings) -> Method:
    def fit(x1: FloatArray, x2: FloatArray, seed: int) -> tuple[FloatArray | None, int | None]:
        ransac = pycolmap.RANSACOptions()
        ransac.max_error, ransac.confidence, ransac.random_seed = options.max_error_px, options.confidence, seed
        ransac.min_num_trials, ransac.max_num_trials = 100, options.max_trials
        found = pycolmap.estimate_fundamental_matrix(x1, x2, ransac)
        return (None if found is None else found["F"]), None

    return fit


def _superansac(options: EpipolarSettings) -> Method:
    pysuperansac = import_rival("pysuperansac")

    def fit(x1: FloatArray, x2: FloatArray, seed: int) -> tuple[FloatArray | None, int | None]:  # noqa: ARG001
        settings = pysuperansac.RANSACSettings()  # a call changes its settings: with used ones, the next one is wrong
        settings.inlier_threshold, settings.confidence = options.max_error_px, options.confidence
        settings.max_iterations = options.max_trials
        settings.sampler = pysuperansac.SamplerType.Uniform  # its default expects matches sorted by quality
        sizes = [float(one[:, axis].max()) + 1.0 for one in (x1, x2) for axis in (0, 1)]
        F = np.asarray(pysuperansac.estimateFundamentalMatrix(np.hstack([x1, x2]), sizes, [], settings)[0])
        return (F if F.shape == (3, 3) else None), None

    return fit


def _openmvg(options: EpipolarSettings) -> Method:
    openmvg = import_rival("openmvg_rs")

    def fit(x1: FloatArray, x2: FloatArray, seed: int) -> tuple[FloatArray | None, int | None]:
        try:
            return openmvg.estimate_fundamental(x1, x2, threshold=options.max_error_px, seed=seed).matrix, None
        except openmvg.EstimationError:
            return None, None

    return fit
