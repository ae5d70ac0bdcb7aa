"""The Huang-Faugeras constraint minimized with equal weights: the thesis's "non-robust" method (5.5.3)."""

from functools import partial

from sfm_app.selfcal.pairs import Pairs
from sfm_app.selfcal.thesis.constraint_forms import EQUATIONS, Equations
from sfm_app.selfcal.thesis.least_squares import fit_camera
from sfm_app.selfcal.thesis.verdict import CameraParameters, calibrate_with
from sfm_app.settings import CalibrationSettings
from sfm_app.types import Calibration, CameraPairs

METHOD = "huang-faugeras"


def calibrate(pairs: CameraPairs, options: CalibrationSettings, seed: int) -> Calibration:
    """Minimize (5.8) from K_init with equal weights.

    Args:
        pairs: F's; weights tell which pairs take part (> 0), and count in the verdict only.
        options: `constraint_form`, which says whether it is (5.8) or another form.
        seed: unused, nothing is drawn at random.

    Returns:
        As `selfcal.thesis.verdict.calibrate_with`, which also says what is raised.
    """
    del seed
    return calibrate_with(METHOD, pairs, partial(_find_camera, equations=EQUATIONS[options.constraint_form]))


def _find_camera(pairs: Pairs, tall: float, evidence: dict[str, float], equations: Equations) -> CameraParameters:
    del evidence
    return fit_camera(pairs, CameraParameters.initial(tall), 0.0 * pairs.weights + 1.0, equations)
