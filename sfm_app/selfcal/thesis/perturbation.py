"""Algorithm 3 of the thesis: pairs that err more than an error of K explains lose their weight (5.7)."""

from functools import partial

import numpy as np

from sfm_app.numerical import MAD_TO_SIGMA
from sfm_app.selfcal.pairs import Pairs
from sfm_app.selfcal.thesis.constraint_forms import EQUATIONS, Equations, essential
from sfm_app.selfcal.thesis.least_squares import DEFAULT, fit_camera
from sfm_app.selfcal.thesis.verdict import CameraParameters, calibrate_with
from sfm_app.settings import CalibrationSettings
from sfm_app.types import Calibration, CameraPairs
from sfm_app.types.arrays import FloatArray

METHOD = "perturbation"
MOST_ITERATIONS = 4
"""maxIter of Algorithm 3 (thesis 5.7.2)."""
TOLERANCE = 1e-6
"""T of Algorithm 3: a change of K, in image widths, that ends the iterations; by hand."""


def calibrate(pairs: CameraPairs, options: CalibrationSettings, seed: int) -> Calibration:
    """Minimize (5.8), or `constraint_form`, with weights from the error discrepancy (thesis Algorithm 3)."""
    del seed
    return calibrate_with(METHOD, pairs, partial(algorithm_3, equations=EQUATIONS[options.constraint_form]))


def algorithm_3(
    pairs: Pairs, tall: float, evidence: dict[str, float], equations: Equations = DEFAULT
) -> CameraParameters:
    """Estimate the camera from K_init by Algorithm 3 as the thesis writes it, in image widths."""
    camera, weights = CameraParameters.initial(tall), np.ones(len(pairs))
    for iteration in range(1, MOST_ITERATIONS + 1):
        before, camera = camera, fit_camera(pairs, camera, weights, equations)
        evidence |= {"iterations": float(iteration), "weighted_pairs": float(np.sum(weights) ** 2 / np.sum(weights**2))}
        if np.linalg.norm(camera.K - before.K) <= TOLERANCE:
            break
        weights = discrepancy_weights(error_discrepancies(pairs.F, camera.K, camera.K - before.K))
    return camera


def error_discrepancies(F: FloatArray, K: FloatArray, change: FloatArray) -> FloatArray:
    """Return thesis (5.23): ((s1 - s2) / (2 |D|))^2, the error of E = K'FK over what an error `change` of K explains.

    |D| is the spectral norm of the part of E's error that K alone causes. (5.22) prints two transposes in the wrong
    place; the expansion of (K + dK)' F (K + dK) gives D = dK'FK + K'F dK + dK'F dK. F (P, 3, 3) has any scale; K is the
    latest estimate, `change` its change since the one before, not zero.
    """
    s = np.linalg.svd(essential(F, K), compute_uv=False)
    D = change.T @ F @ K + K.T @ F @ change + change.T @ F @ change
    bound = 2 * np.linalg.norm(D, ord=2, axis=(1, 2))
    return np.asarray(((s[:, 0] - s[:, 1]) / np.maximum(bound, np.finfo(np.float64).tiny)) ** 2)


def discrepancy_weights(discrepancies: FloatArray) -> FloatArray:
    """Return thesis (5.24): exp(-ED / s), s = 1.4826 MAD; equal weights where the discrepancies do not scatter."""
    scale = MAD_TO_SIGMA * float(np.median(np.abs(discrepancies - np.median(discrepancies))))
    if scale == 0:
        return np.ones(len(discrepancies))
    # subtracting the smallest discrepancy only scales the weights: without it all of them may underflow
    return np.asarray(np.exp(-(discrepancies - np.min(discrepancies)) / scale))
