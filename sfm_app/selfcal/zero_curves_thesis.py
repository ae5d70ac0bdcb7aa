"""Algorithm 4 of the thesis to the letter: zero curves in (fx, fy), their meeting point, then the same in (u, v)."""

import numpy as np

from sfm_app.selfcal.answers import camera_matrix, guessed
from sfm_app.selfcal.consensus import meeting_point
from sfm_app.selfcal.curves import centre_curves, focal_curves, usable
from sfm_app.selfcal.inputs import FloatArray, prepare
from sfm_app.settings import CalibrationSettings
from sfm_app.types import Calibration

METHOD = "zero-curves-thesis"
FOCAL_RANGE = 3.0
"""Focals are sought up to this many image widths (thesis 5.29)."""
SIGMA_SHARE = 0.1
"""sigma of rho, as a share of the range that is searched (thesis 5.8.4)."""


def calibrate(
    Fs: FloatArray, weights: FloatArray, size: tuple[int, int], options: CalibrationSettings, seed: int
) -> Calibration:
    """Find K where the zero curves of all pairs meet (thesis Algorithm 4).

    The thesis gives every pair the same say, so weights only tell which pairs take part (> 0). Nothing is drawn at random.

    Args:
        Fs: (P, 3, 3) in pixels.
        weights: (P,), >= 0.
        size: (width, height) in pixels.
        options: `samples` along each curve.
        seed: unused.

    Raises:
        ValueError: malformed input, see `selfcal.inputs.prepare`.
    """
    del seed
    width, height = size
    pairs = prepare(Fs, weights, size, unit_px=width, origin_px=(0.0, 0.0))
    tall = height / width
    sweep = np.arange(1, options.samples + 1) / options.samples
    evidence = {"pairs": float(len(pairs))}

    fx = FOCAL_RANGE * sweep
    curves = usable(focal_curves(pairs, fx, (0.5, 0.5 * tall)), FOCAL_RANGE)
    evidence["focal_curves"] = float(len(curves))
    focal = meeting_point(curves, FOCAL_RANGE, SIGMA_SHARE * FOCAL_RANGE)
    if focal is None:
        return guessed(size, f"{len(curves)} of {len(pairs)} pairs have a usable focal curve, 2 are needed", evidence)
    evidence["focal_support"] = focal.support

    curves = usable(centre_curves(pairs, sweep, (fx[focal.sample], focal.value)), tall)
    evidence["centre_curves"] = float(len(curves))
    centre = meeting_point(curves, tall, SIGMA_SHARE * tall)
    if centre is None:
        return guessed(size, f"{len(curves)} of {len(pairs)} pairs have a usable centre curve, 2 are needed", evidence)
    evidence["centre_support"] = centre.support
    K = camera_matrix(fx[focal.sample] * width, focal.value * width, sweep[centre.sample] * width, centre.value * width)
    return Calibration(K, width, height, METHOD, identifiable=True, evidence=evidence)
