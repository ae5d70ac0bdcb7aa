"""The Huang-Faugeras constraint minimized over all pairs alike: the thesis's "non-robust" method (5.5.3)."""

from sfm_app.selfcal.inputs import Pairs
from sfm_app.selfcal.thesis.least_squares import fitted
from sfm_app.selfcal.thesis.verdict import Camera, answered
from sfm_app.settings import CalibrationSettings
from sfm_app.types import Calibration, CameraPairs

METHOD = "huang-faugeras"


def calibrate(pairs: CameraPairs, options: CalibrationSettings, seed: int) -> Calibration:
    """Minimize (5.8) from K_init with equal weights.

    Args:
        pairs: F's; weights tell which pairs take part (> 0), and count in the verdict only.
        options: unused.
        seed: unused, nothing is drawn at random.

    Returns:
        As `selfcal.verdict.answered`, which also says what is raised.
    """
    del options, seed
    return answered(METHOD, pairs, _found)


def _found(pairs: Pairs, tall: float, evidence: dict[str, float]) -> Camera:
    del evidence
    return fitted(pairs, Camera.initial(tall), 0.0 * pairs.weights + 1.0)
