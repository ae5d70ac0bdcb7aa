"""Critical motions leave the focal open: E = K'FK has equal singular values at any focal.

Sturm (1999); the degenerate motions of thesis 5.4. Recognizing them by the estimated poses is ours.
"""

import numpy as np
from numpy.typing import NDArray

from sfm_app.selfcal.adjustment.calibrate_pairs import Fit

FloatArray = NDArray[np.float64]

LEAST_ROTATION_DEG = 3.0
"""Median rotation of pairs below which the axes count as parallel. Chosen by hand; halved and doubled by
`benchmarks.sensitivity`."""
ISOSCELES = 0.1
"""Largest median deviation, in cosines, of pairs whose axes meet at one distance from both cameras. Chosen by hand;
halved and doubled by `benchmarks.sensitivity`."""


def critical_motion(fit: Fit) -> str:
    """Return the critical motion of most pairs in words for the user; empty where there is none.

    Parallel axes, and axes that meet at one distance from both cameras (an isosceles triangle, as on an orbit), are the
    two for which one pair does not constrain the focal (Sturm 1999).
    """
    R = fit.state.poses[:, :9].reshape(-1, 3, 3)
    if len(R) == 0:
        return ""
    turned = np.degrees(np.arccos(np.clip((np.trace(R, axis1=1, axis2=2) - 1.0) / 2.0, -1.0, 1.0)))
    if np.median(turned) < LEAST_ROTATION_DEG:
        return "the camera hardly turned between the photos (parallel axes)"
    baseline = -np.einsum("pij,pi->pj", R, fit.state.poses[:, 9:])
    second = R[:, 2]
    # in the frame of view 1, whose axis is z: both axes lean alike towards the baseline, and all three lie in a plane
    lean = np.abs(baseline[:, 2] + np.einsum("pi,pi->p", second, baseline))
    out_of_plane = np.abs(np.cross(second, baseline)[:, 2])
    if np.median(np.maximum(lean, out_of_plane)) < ISOSCELES:
        return "the photos look at one point from one distance (an orbit)"
    return ""
