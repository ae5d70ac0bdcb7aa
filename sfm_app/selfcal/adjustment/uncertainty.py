"""Uncertainty of a fit: covariances, standard deviations in pixels, and the most informative pairs.

Ours; leaving out photos is the jackknife (Efron 1982). Key pairs are what chapter 6 of the thesis asks for.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sfm_app.geometry.spd_solve import lift_eigenvalues
from sfm_app.selfcal.adjustment.calibrate_pairs import Fit, jackknife_deviations
from sfm_app.selfcal.adjustment.structureless_ba import OWN_CAMERA_SIGMAS
from sfm_app.selfcal.adjustment.two_view_cost import CAMERA
from sfm_app.selfcal.lens import CENTER_U, CENTER_V, KAPPA, LOG_ASPECT, LOG_FOCAL
from sfm_app.types import PairId
from sfm_app.types.correlations import named_correlations

FloatArray = NDArray[np.float64]

NAMES = ("fx", "fy", "cx", "cy", "k1")
MODEL_ERROR = np.array([1e-3, 1e-3, 1e-3, 1e-3, 3e-3])
"""Standard deviations of errors that no lens model covers: of log f, u and v in longer sides, log a, and k1.
docs/algorithms.md, Self-calibration, 4. Chosen by hand; halved and doubled by `benchmarks.sensitivity`."""
LEAST_KEY_WEIGHT = 0.5
"""A pair with a smaller weight in the fit is no key pair. docs/algorithms.md, Self-calibration, 7. Chosen by hand;
halved and doubled by `benchmarks.sensitivity`."""


def covariance(fit: Fit, sides: FloatArray, *, resampled: bool = False) -> FloatArray:
    """Return the (5C, 5C) covariance of all parameters over all choices of free ones, plus the model error.

    Args:
        fit: cameras adjusted to matches.
        sides: (C,) longer sides of the photos.
        resampled: widen it where leaving photos out moves the cameras further than it predicts.
    """
    found = fit.evidence.covariance(fit.free)
    if resampled:
        deviations = np.sqrt(np.diag(found))
        wider = np.maximum(jackknife_deviations(fit) / deviations, 1.0)
        found = found * np.outer(wider, wider)
    floor = np.tile(MODEL_ERROR, (len(sides), 1))
    floor[:, CENTER_U : CENTER_V + 1] *= sides[:, None]
    floor[:, KAPPA] /= np.exp(2.0 * fit.state.thetas[:, LOG_FOCAL])
    return np.asarray(found + np.diag(floor.ravel() ** 2), np.float64)


class Uncertainty(NamedTuple):
    """How far the parameters of a camera may be off, and which of them are off together; as in `Calibration`."""

    spread: dict[str, float]
    correlations: dict[str, float]


def camera_uncertainty(theta: FloatArray, cov: FloatArray, unit_px: float) -> Uncertainty:
    """Return the standard deviations of fx, fy, cx, cy in pixels and of k1, and their correlations.

    Args:
        theta: (5,) parameters of the camera.
        cov: (5, 5) their covariance.
        unit_px: pixels per unit of theta.
    """
    focal, squared = float(np.exp(theta[LOG_FOCAL])) * unit_px, float(np.exp(2.0 * theta[LOG_FOCAL]))
    half = float(np.exp(0.5 * theta[LOG_ASPECT]))
    # rows: how fx, fy, cx, cy, k1 change with log f, u, v, log a, kappa
    slopes = np.zeros((CAMERA, CAMERA))
    slopes[0, [LOG_FOCAL, LOG_ASPECT]] = focal / half, -0.5 * focal / half
    slopes[1, [LOG_FOCAL, LOG_ASPECT]] = focal * half, 0.5 * focal * half
    slopes[2, CENTER_U] = slopes[3, CENTER_V] = unit_px
    slopes[4, [LOG_FOCAL, KAPPA]] = 2.0 * theta[KAPPA] * squared, squared
    found = slopes @ cov @ slopes.T
    deviations = np.sqrt(np.maximum(np.diag(found), 0.0))
    return Uncertainty(dict(zip(NAMES, deviations.tolist(), strict=True)), named_correlations(NAMES, found))


def key_pairs(fit: Fit, photos: tuple[PairId, ...]) -> tuple[PairId, ...]:
    """Return the pairs that agree with the cameras, the most informative first.

    Their views differ in more than position.

    Args:
        fit: cameras adjusted to P pairs.
        photos: (P,) the two photos of each; may be empty.
    """
    if not photos:
        return ()
    alone = np.tile(OWN_CAMERA_SIGMAS, 2)
    news = np.linalg.slogdet(lift_eigenvalues(np.eye(2 * CAMERA) + alone[:, None] * fit.information.hessians * alone))[
        1
    ]
    worth = fit.state.weights * news
    order = [pair for pair in np.argsort(-worth, kind="stable") if fit.state.weights[pair] >= LEAST_KEY_WEIGHT]
    return tuple(photos[pair] for pair in order)
