"""What a calibrator hands back."""

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from sfm_app.geometry.camera import camera_matrix, guessed_camera_matrix
from sfm_app.selfcal.lens import CENTRE_U, CENTRE_V, KAPPA, LOG_ASPECT, LOG_FOCAL
from sfm_app.types import Calibration

GUESS = "guess"


def guessed(size: tuple[int, int], reason: str, evidence: Mapping[str, float]) -> Calibration:
    """The usual guess with the reason why nothing better is known."""
    K = guessed_camera_matrix(size)
    return Calibration(K, *size, GUESS, identifiable=False, reason=reason, evidence=dict(evidence))


def calibration_of(theta: NDArray[np.float64], size: tuple[int, int], method: str) -> Calibration:
    """An answer from the parameters (5,) of `lens`, in longer sides about the middle."""
    side = float(max(size))
    focal, half = float(np.exp(theta[LOG_FOCAL])), float(np.exp(0.5 * theta[LOG_ASPECT]))
    cx, cy = side * theta[CENTRE_U] + size[0] / 2, side * theta[CENTRE_V] + size[1] / 2
    K = camera_matrix(side * focal / half, side * focal * half, float(cx), float(cy))
    return Calibration(K, *size, method, identifiable=True, radial=float(theta[KAPPA]) * focal**2)
