"""Algorithm 4 of the thesis to the letter: zero curves in (fx, fy), their meeting point, then the same in (u, v)."""

from functools import partial

import numpy as np

from sfm_app.selfcal.inputs import Pairs
from sfm_app.selfcal.thesis.curves import center_curves, focal_curves, usable_curves
from sfm_app.selfcal.thesis.meeting_point import meeting_point, meeting_points
from sfm_app.selfcal.thesis.verdict import CameraParameters, calibrate_with
from sfm_app.settings import CalibrationSettings
from sfm_app.types import Calibration, CameraPairs

METHOD = "zero-curves-thesis"
FOCAL_RANGE = 3.0
"""Focals are sought up to this many image widths (thesis 5.8.3, Eq. 5.29)."""
SIGMA_SHARE = 0.1
"""sigma of rho, as a share of the range that is searched (thesis 5.8.4)."""
PEAK_RANGE, PEAK_SIGMA = (0.3, FOCAL_RANGE), 0.1
"""Where peaks are sought and how wide they are, in image widths: small beside the distance between two cameras. Chosen
by hand; halved and doubled by `benchmarks.sensitivity`."""


def calibrate(pairs: CameraPairs, options: CalibrationSettings, seed: int) -> Calibration:
    """Find K where the zero curves of all pairs meet (thesis Algorithm 4).

    The thesis gives every pair the same weight: the given weights tell which pairs take part (> 0), and count in the
    verdict only.

    Args:
        pairs: F's and weights.
        options: `samples` along each curve.
        seed: unused, nothing is drawn at random.

    Returns:
        As `selfcal.thesis.verdict.calibrate_with`, which also says what is raised.
    """
    del seed
    return calibrate_with(METHOD, pairs, partial(algorithm_4, samples=options.samples))


def algorithm_4(pairs: Pairs, tall: float, evidence: dict[str, float], samples: int) -> CameraParameters | str:
    """Estimate the camera by Algorithm 4 as the thesis writes it; return why not where too few curves are usable.

    Several `focal_peaks` are several cameras (Figure 5.15), of which the answer is one.

    Args:
        pairs: P fundamental matrices in image widths.
        tall: height of the photos in widths.
        evidence: filled with the number of curves, their support where they meet, and the number of its peaks.
        samples: of a sweep, > 0.
    """
    sweep = np.arange(1, samples + 1) / samples
    fx = FOCAL_RANGE * sweep
    curves = usable_curves(focal_curves(pairs, fx, (0.5, 0.5 * tall)), FOCAL_RANGE)
    evidence["focal_curves"] = float(len(curves))
    focal = meeting_point(curves, FOCAL_RANGE, SIGMA_SHARE * FOCAL_RANGE)
    if focal is None:
        return f"{len(curves)} of {len(pairs)} pairs have a usable focal curve, 2 are needed"
    evidence["focal_support"] = focal.support
    evidence["focal_peaks"] = float(len(meeting_points(curves, fx, PEAK_RANGE, PEAK_SIGMA)))

    curves = usable_curves(center_curves(pairs, sweep, (fx[focal.sample], focal.value)), tall)
    evidence["center_curves"] = float(len(curves))
    center = meeting_point(curves, tall, SIGMA_SHARE * tall)
    if center is None:
        return f"{len(curves)} of {len(pairs)} pairs have a usable center curve, 2 are needed"
    evidence["center_support"] = center.support
    return CameraParameters(float(fx[focal.sample]), focal.value, float(sweep[center.sample]), center.value)
