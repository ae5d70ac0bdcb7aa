"""Weights from the epipolar residuals (Mendonca and Cipolla 1999): the thesis's "Geometric" method (5.3)."""

from dataclasses import replace
from functools import partial

import numpy as np

from sfm_app.geometry.epipolar import sampson_distance
from sfm_app.selfcal.pairs import Pairs, check_pairs
from sfm_app.selfcal.thesis.constraint_forms import EQUATIONS, Equations
from sfm_app.selfcal.thesis.least_squares import fit_camera
from sfm_app.selfcal.thesis.verdict import CameraParameters, calibrate_with
from sfm_app.settings import CalibrationSettings
from sfm_app.types import Calibration, CameraPairs
from sfm_app.types.arrays import FloatArray

METHOD = "geometric"
LEAST_RESIDUAL_PX = 1e-3
"""Least residual: it bounds the weight of exact matches. docs/algorithms/self-calibration.md; by hand."""


def calibrate(pairs: CameraPairs, options: CalibrationSettings, seed: int) -> Calibration:
    """Minimize (5.8), or `constraint_form`, from K_init, each pair over its mean epipolar residual."""
    del seed
    weighted = replace(pairs, weights=residual_weights(pairs)) if pairs.inliers else pairs
    return calibrate_with(METHOD, weighted, partial(_find_camera, equations=EQUATIONS[options.constraint_form]))


def residual_weights(pairs: CameraPairs) -> FloatArray:
    """Return (P,) 1 / mean Sampson distance of a pair's inliers, with mean 1 over the pairs that take part.

    Pairs of weight 0 keep it; a pair without inliers, or with infinite distances, gets weight 0.

    Raises:
        ValueError: malformed input, see `selfcal.pairs.prepare`.
    """
    check_pairs(pairs)
    residuals = [
        float(np.mean(sampson_distance(F, matches[:, :2], matches[:, 2:]))) if len(matches) else np.inf
        for F, matches in zip(pairs.Fs, pairs.inliers, strict=True)
    ]
    weights = np.where(pairs.weights > 0, 1.0 / np.maximum(residuals, LEAST_RESIDUAL_PX), 0.0)
    total = np.sum(weights)
    return np.asarray(weights * np.count_nonzero(weights) / total if total > 0 else weights)


def _find_camera(pairs: Pairs, tall: float, evidence: dict[str, float], equations: Equations) -> CameraParameters:
    del evidence
    return fit_camera(pairs, CameraParameters.initial(tall), pairs.weights, equations)
