"""What a calibrator hands back, known or not."""

from collections.abc import Mapping

import numpy as np

from sfm_app.selfcal.inputs import FloatArray
from sfm_app.types import Calibration

GUESSED_FOCAL = 1.2
"""Focal of a camera about which nothing is known, in units of the longer side; COLMAP guesses the same."""
GUESS = "guess"


def camera_matrix(fx: float, fy: float, cx: float, cy: float) -> FloatArray:
    """K without skew, in the unit of its arguments."""
    return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])


def guessed(size: tuple[int, int], reason: str, evidence: Mapping[str, float]) -> Calibration:
    """The answer where the pairs do not determine K: a focal of 1.2 longer sides, the centre in the middle."""
    width, height = size
    focal_px = GUESSED_FOCAL * max(size)
    K = camera_matrix(focal_px, focal_px, width / 2, height / 2)
    return Calibration(K, width, height, GUESS, identifiable=False, reason=reason, evidence=dict(evidence))
