"""Zero Curves as the product uses it: the consensus of thesis (5.33) over all of K at once, and what supports it."""

import numpy as np

from sfm_app.selfcal.answers import camera_matrix, guessed
from sfm_app.selfcal.inputs import FloatArray, prepare
from sfm_app.selfcal.joint import CENTRE_U, CENTRE_V, LOG_FOCAL, Consensus
from sfm_app.selfcal.search import highest_peak, scan
from sfm_app.settings import CalibrationSettings
from sfm_app.types import Calibration

METHOD = "zero-curves"


def calibrate(
    Fs: FloatArray, weights: FloatArray, size: tuple[int, int], options: CalibrationSettings, seed: int
) -> Calibration:
    width, height = size
    unit = max(size)
    pairs = prepare(Fs, weights, size, unit_px=unit, origin_px=(width / 2, height / 2))
    if len(pairs) < 3:
        return guessed(size, METHOD, f"too few pairs: {len(pairs)}, 3 are needed", {"pairs": float(len(pairs))})
    consensus = Consensus(pairs, options.centre_sigma * width / unit)
    peak = highest_peak(consensus, scan(consensus, (0.0,)), (LOG_FOCAL, CENTRE_U, CENTRE_V))
    f = np.exp(peak.theta[0]) * unit
    K = camera_matrix(f, f, width / 2 + unit * peak.theta[1], height / 2 + unit * peak.theta[2])
    return Calibration(K, width, height, METHOD, identifiable=True, evidence={"pairs": float(len(pairs))})
