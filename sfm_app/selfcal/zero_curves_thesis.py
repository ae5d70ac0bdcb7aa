"""Algorithm 4 of the thesis to the letter: zero curves in (fx, fy), their meeting point, then the same in (u, v).

Only the verdict is not the thesis's: what comes out counts as known where the pairs satisfy the constraint there, and
do not satisfy it as well at other focals.
"""

from typing import NamedTuple

import numpy as np

from sfm_app.geometry.camera import camera_matrix
from sfm_app.selfcal.answers import guessed
from sfm_app.selfcal.consensus import meeting_point
from sfm_app.selfcal.curves import centre_curves, focal_curves, usable
from sfm_app.selfcal.evidence import best_rival, disagreement, indecision, votes
from sfm_app.selfcal.inputs import Pairs, prepare
from sfm_app.selfcal.joint import Consensus
from sfm_app.selfcal.search import SIGMAS
from sfm_app.settings import CalibrationSettings
from sfm_app.types import Calibration, CameraPairs

METHOD = "zero-curves-thesis"
FOCAL_RANGE = 3.0
"""Focals are sought up to this many image widths (thesis 5.29)."""
SIGMA_SHARE = 0.1
"""sigma of rho, as a share of the range that is searched (thesis 5.8.4)."""


class Found(NamedTuple):
    """What Algorithm 4 returns, in image widths from the top left corner."""

    fx: float
    fy: float
    u: float
    v: float


def calibrate(pairs: CameraPairs, options: CalibrationSettings, seed: int) -> Calibration:
    """Find K where the zero curves of all pairs meet (thesis Algorithm 4).

    The thesis gives every pair the same say: weights tell which pairs take part (> 0), and count in the verdict only.

    Args:
        pairs: F's and weights.
        options: `samples` along each curve.
        seed: unused, nothing is drawn at random.

    Returns:
        K with ``identifiable=True``, or a guess and the reason. `evidence` has what Algorithm 4 answered in both cases,
        as fx_px, fy_px, cx_px and cy_px.

    Raises:
        ValueError: malformed input, see `selfcal.inputs.prepare`.
    """
    del seed
    width, height = size = pairs.size
    usable = prepare(pairs, unit_px=width, origin_px=(0.0, 0.0))
    evidence = {"pairs": float(len(usable))}
    found = algorithm_4(usable, height / width, options.samples, evidence)
    if isinstance(found, str):
        return guessed(size, found, evidence)
    fx, fy, cx, cy = (width * value for value in found)
    evidence |= {"fx_px": fx, "fy_px": fy, "cx_px": cx, "cy_px": cy}
    theta = np.array([0.5 * np.log(found.fx * found.fy), found.u, found.v, np.log(found.fy / found.fx)])
    # the wider sigma: a sample of a curve is no maximum, and must not be held against the last per cent
    consensus, sigmas = Consensus(usable, np.inf), SIGMAS[:1]
    given = votes(consensus, theta, sigmas[-1])
    lead = float(np.sum(given)) - best_rival(consensus, theta, range(4), sigmas)
    evidence |= {"support": float(np.sum(given) / np.sum(usable.weights)), "lead": lead}
    reason = disagreement(given, usable.weights) or indecision(lead, given)
    if reason:
        return guessed(size, reason, evidence)
    K = camera_matrix(fx, fy, cx, cy)
    return Calibration(K, width, height, METHOD, identifiable=True, evidence=evidence)


def algorithm_4(pairs: Pairs, tall: float, samples: int, evidence: dict[str, float]) -> Found | str:
    """The algorithm itself, for an image of width 1 and height `tall`; the reason where too few curves are usable.

    Fills `evidence` with the number of curves and their support at the meeting points.
    """
    sweep = np.arange(1, samples + 1) / samples
    fx = FOCAL_RANGE * sweep
    curves = usable(focal_curves(pairs, fx, (0.5, 0.5 * tall)), FOCAL_RANGE)
    evidence["focal_curves"] = float(len(curves))
    focal = meeting_point(curves, FOCAL_RANGE, SIGMA_SHARE * FOCAL_RANGE)
    if focal is None:
        return f"{len(curves)} of {len(pairs)} pairs have a usable focal curve, 2 are needed"
    evidence["focal_support"] = focal.support

    curves = usable(centre_curves(pairs, sweep, (fx[focal.sample], focal.value)), tall)
    evidence["centre_curves"] = float(len(curves))
    centre = meeting_point(curves, tall, SIGMA_SHARE * tall)
    if centre is None:
        return f"{len(curves)} of {len(pairs)} pairs have a usable centre curve, 2 are needed"
    evidence["centre_support"] = centre.support
    return Found(float(fx[focal.sample]), focal.value, float(sweep[centre.sample]), centre.value)
