"""Algorithm 4 of the thesis to the letter: zero curves in (fx, fy), their meeting point, then the same in (u, v)."""

from functools import partial
from typing import NamedTuple

import numpy as np

from sfm_app.jit import kernel
from sfm_app.selfcal.pairs import Pairs
from sfm_app.selfcal.thesis.curves import center_curves, focal_curves, usable_curves
from sfm_app.selfcal.thesis.verdict import CameraParameters, calibrate_with
from sfm_app.settings import CalibrationSettings
from sfm_app.types import Calibration, CameraPairs
from sfm_app.types.arrays import FloatArray

# The point where most zero curves meet, or the points, where several cameras took the photos (thesis 5.8.4).

SEPARATION = 1.25
"""Peaks with focals sqrt(fx fy) within this factor are one. docs/algorithms/self-calibration.md; by hand."""
LEAST_SHARE = 0.5
"""A peak has at least this share of the highest one's support; accidental meeting points mostly have less.
docs/algorithms/self-calibration.md; by hand."""


class Meeting(NamedTuple):
    """The sample of a curve that the other curves pass closest to."""

    sample: int
    """Index j* along the sweep."""
    value: float
    """Z_k*(j*)."""
    support: float
    """Mean of rho over the other curves there, in [0, 1]."""


def meeting_point(curves: FloatArray, upper: float, sigma: float) -> Meeting | None:
    """Return the meeting point of thesis (5.33), with its argmin corrected to argmax.

    It is the sample within (0, upper) with the highest support by the other curves. The distance d is that of (5.34),
    the difference at the same sample of the sweep; rho(d) = exp(-d / sigma) with sigma a tenth of the range. `curves`
    (C, S) are not degenerate. None where there are fewer than two curves, or no sample within the range.
    """
    if len(curves) < 2:
        return None
    supports = _supports(curves, (0.0, upper), sigma)
    k, j = divmod(int(np.argmax(supports)), curves.shape[1])
    return Meeting(j, float(curves[k, j]), float(supports[k, j])) if supports[k, j] >= 0 else None


def meeting_points(curves: FloatArray, sweep: FloatArray, limits: tuple[float, float], sigma: float) -> list[Meeting]:
    """Return all well-separated peaks of the support along the sweep: the cameras in a set of several (Figure 5.15).

    A peak is higher than its neighbors along the sweep, `SEPARATION` away from higher peaks, and has `LEAST_SHARE` of
    the highest one's support. `curves` (C, S) are focal curves fy that are not degenerate, at rising fx of `sweep`
    (S,). Only fx and fy between the limits are answers; near 0 all curves bunch up, so 0 is no good lower limit. sigma
    is as in `meeting_point`, but small beside the distance between the cameras' focals. Peaks have falling support.
    """
    if len(curves) < 2:
        return []
    supports = _supports(curves, limits, sigma)
    supports[:, (sweep <= limits[0]) | (sweep >= limits[1])] = -1.0
    best = np.argmax(supports, axis=0)
    profile, values = (table[best, np.arange(len(sweep))] for table in (supports, curves))
    is_top = np.concatenate([[False], (profile[1:-1] > profile[:-2]) & (profile[1:-1] >= profile[2:]), [False]])
    tops = np.flatnonzero(is_top & (profile >= LEAST_SHARE * np.max(profile)) & (profile > 0))
    log_focals = 0.5 * np.log(sweep * np.where(profile > 0, values, 1.0))
    kept: list[int] = []
    for j in tops[np.argsort(-profile[tops], kind="stable")]:
        if np.all(np.abs(log_focals[j] - log_focals[kept]) >= np.log(SEPARATION)):
            kept.append(int(j))
    return [Meeting(j, float(values[j]), float(profile[j])) for j in kept]


def _supports(curves: FloatArray, limits: tuple[float, float], sigma: float) -> FloatArray:
    """Return (C, S) mean of rho over the other curves; -1 where the value is not between the limits."""
    scores = _scores(np.ascontiguousarray(curves), sigma) / (len(curves) - 1)
    return np.where((curves > limits[0]) & (curves < limits[1]), scores, -1.0)


@kernel
def _scores(curves: FloatArray, sigma: float) -> FloatArray:
    count, samples = curves.shape
    scores = np.zeros((count, samples))
    for k in range(count):
        for i in range(k):
            for j in range(samples):
                rho = np.exp(-abs(curves[k, j] - curves[i, j]) / sigma)
                scores[k, j] += rho
                scores[i, j] += rho
    return scores


METHOD = "zero-curves-thesis"
FOCAL_RANGE = 3.0
"""Focals are sought up to this many image widths (thesis 5.8.3, Eq. 5.29)."""
SIGMA_SHARE = 0.1
"""sigma of rho, as a share of the range that is searched (thesis 5.8.4)."""
PEAK_RANGE, PEAK_SIGMA = (0.3, FOCAL_RANGE), 0.1
"""Range and width of the peaks, in image widths: small beside the distance between two cameras; by hand."""


def calibrate(pairs: CameraPairs, options: CalibrationSettings, seed: int) -> Calibration:
    """Find K where the zero curves of all pairs meet (thesis Algorithm 4); weights select pairs."""
    del seed
    return calibrate_with(METHOD, pairs, partial(algorithm_4, samples=options.samples))


def algorithm_4(pairs: Pairs, tall: float, evidence: dict[str, float], samples: int) -> CameraParameters | str:
    """Estimate the camera by Algorithm 4 as the thesis writes it; return why not where too few curves are usable.

    Several `focal_peaks` are several cameras (Figure 5.15), of which the answer is one. Adds the number of curves,
    their support where they meet, and the number of its peaks to the evidence.
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
