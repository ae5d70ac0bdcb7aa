"""Self-calibration: the camera matrix from fundamental matrices (thesis chapter 5).

docs/symbols.md has the symbols of the thesis and their names here.
"""

from sfm_app.selfcal import zero_curves
from sfm_app.selfcal.pairs import pair_weights
from sfm_app.selfcal.photo_set import CalibratedCamera, CalibrateFunction, calibrate_photo_set
from sfm_app.selfcal.thesis import geometric, kruppa, least_squares, multi_start, perturbation
from sfm_app.selfcal.thesis import zero_curves as zero_curves_thesis
from sfm_app.selfcal.thesis.verdict import CameraParameters, calibrate_with

__all__ = [
    "CALIBRATORS",
    "SEVERAL_CAMERAS",
    "CalibrateFunction",
    "CalibratedCamera",
    "CameraParameters",
    "calibrate_photo_set",
    "calibrate_with",
    "pair_weights",
]

CALIBRATORS: dict[str, tuple[CalibrateFunction, str]] = {
    zero_curves.METHOD: (
        zero_curves.calibrate,
        "consensus of all pairs over all of K, then cameras and lens adjusted to the matches; several cameras",
    ),
    zero_curves_thesis.METHOD: (
        zero_curves_thesis.calibrate,
        "thesis Algorithm 4 to the letter: zero curves of the focals, then of the center",
    ),
    multi_start.METHOD: (
        multi_start.calibrate,
        "thesis Algorithm 2: least squares on random triples of pairs from random cameras",
    ),
    perturbation.METHOD: (
        perturbation.calibrate,
        "thesis Algorithm 3: least squares that downweights pairs whose error no error of the camera explains",
    ),
    geometric.METHOD: (
        geometric.calibrate,
        "least squares weighted by the epipolar residuals of each pair, a benchmark of the thesis",
    ),
    least_squares.METHOD: (
        least_squares.calibrate,
        "least squares with equal weights for all pairs, the thesis's non-robust benchmark",
    ),
    kruppa.METHOD: (kruppa.calibrate, "least squares over the Kruppa equations, from their focal-only solution"),
}
"""Every calibrator by name, with a line about it."""

SEVERAL_CAMERAS = zero_curves.METHOD
"""The calibrator that also splits groups and uses pairs between cameras."""
