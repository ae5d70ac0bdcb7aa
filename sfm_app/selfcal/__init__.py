"""Self-calibration: the camera matrix from fundamental matrices (thesis chapter 5)."""

from collections.abc import Callable

from sfm_app.selfcal import (
    geometric,
    huang_faugeras,
    kruppa,
    multi_start,
    perturbation,
    zero_curves,
    zero_curves_thesis,
)
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
    multi_start.METHOD: (
        multi_start.calibrate,
        "thesis Algorithm 2: least squares on random triples of pairs from random cameras",
    ),
    perturbation.METHOD: (
        perturbation.calibrate,
        "thesis Algorithm 3: least squares that mistrusts pairs no error of the camera explains",
    ),
    geometric.METHOD: (
        geometric.calibrate,
        "least squares weighted by the epipolar residuals of each pair, a benchmark of the thesis",
    ),
    huang_faugeras.METHOD: (
        huang_faugeras.calibrate,
        "least squares over all pairs alike, the thesis's non-robust benchmark",
    ),
    kruppa.METHOD: (
        kruppa.calibrate,
        "least squares over the Kruppa equations, from their focal-only solution",
    ),
}
"""Every calibrator by name, with a line about it."""
