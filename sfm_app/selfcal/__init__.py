"""Self-calibration: the camera matrix from fundamental matrices (thesis chapter 5)."""

from collections.abc import Callable

from sfm_app.selfcal import zero_curves, zero_curves_thesis
from sfm_app.selfcal.inputs import pair_weights
from sfm_app.settings import CalibrationSettings
from sfm_app.types import Calibration, CameraPairs

__all__ = ["CALIBRATORS", "CalibrateFunction", "pair_weights"]

CalibrateFunction = Callable[[CameraPairs, CalibrationSettings, int], Calibration]

CALIBRATORS: dict[str, tuple[CalibrateFunction, str]] = {
    zero_curves.METHOD: (
        zero_curves.calibrate,
        "consensus of all pairs over focal, centre and, where the photos show it, fy/fx at once",
    ),
    zero_curves_thesis.METHOD: (
        zero_curves_thesis.calibrate,
        "thesis Algorithm 4 to the letter: zero curves of the focals, then of the centre",
    ),
}
"""Every calibrator by name, with a line about it."""
