"""Results of a calibrator.

Ours; the thesis gives a K in any case.
"""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from sfm_app.geometry.camera import camera_matrix, guessed_camera_matrix
from sfm_app.selfcal.lens import CENTER_U, CENTER_V, KAPPA, LOG_ASPECT, LOG_FOCAL
from sfm_app.types import Calibration

GUESS = "guess"
ESTIMATE = "estimate"
"""Method of a camera that the photos determine roughly."""


def guess_calibration(size: tuple[int, int], reason: str, evidence: Mapping[str, float]) -> Calibration:
    """Return the usual guess with the reason why nothing better is known.

    Args:
        size: (width, height) of the photos in pixels.
        reason: why nothing better is known, for the user.
        evidence: numbers by name, to go with the answer.
    """
    K = guessed_camera_matrix(size)
    return Calibration(K, *size, GUESS, identifiable=False, reason=reason, evidence=dict(evidence))


def calibration_from_parameters(
    theta: NDArray[np.float64], size: tuple[int, int], method: str, unit_px: float | None = None
) -> Calibration:
    """Return the calibration with the parameters of `lens`, which count from the middle of the photo.

    Args:
        theta: (5,) log f, u, v, log a, kappa.
        size: (width, height) of the photo in pixels.
        method: name of what found them.
        unit_px: pixels per unit of theta; the longer side where None.
    """
    unit = float(max(size)) if unit_px is None else unit_px
    focal, half = float(np.exp(theta[LOG_FOCAL])), float(np.exp(0.5 * theta[LOG_ASPECT]))
    cx, cy = unit * theta[CENTER_U] + size[0] / 2, unit * theta[CENTER_V] + size[1] / 2
    K = camera_matrix(unit * focal / half, unit * focal * half, float(cx), float(cy))
    return Calibration(K, *size, method, identifiable=True, radial=float(theta[KAPPA]) * focal**2)


def downgrade_to_estimate(found: Calibration, reason: str) -> Calibration:
    """Return the calibration, as an estimate that is not relied on if there is a reason for that.

    Args:
        found: the answer.
        reason: why it is not relied on, for the user; empty for none.
    """
    return replace(found, identifiable=False, method=ESTIMATE, reason=reason) if reason else found


def parameters_from_calibration(found: Calibration, unit_px: float) -> NDArray[np.float64]:
    """Return the parameters (5,) that `calibration_from_parameters` was made from.

    Args:
        found: the answer.
        unit_px: pixels per unit of the parameters.
    """
    focal = found.focal_px / unit_px
    u, v = (found.K[0, 2] - found.width / 2) / unit_px, (found.K[1, 2] - found.height / 2) / unit_px
    return np.array([np.log(focal), u, v, np.log(found.K[1, 1] / found.K[0, 0]), found.radial / focal**2])
