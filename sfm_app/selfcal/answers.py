"""What a calibrator hands back when the pairs do not determine K."""

from collections.abc import Mapping

from sfm_app.geometry.camera import guessed_camera_matrix
from sfm_app.types import Calibration

GUESS = "guess"


def guessed(size: tuple[int, int], reason: str, evidence: Mapping[str, float]) -> Calibration:
    """The usual guess with the reason why nothing better is known."""
    K = guessed_camera_matrix(size)
    return Calibration(K, *size, GUESS, identifiable=False, reason=reason, evidence=dict(evidence))
