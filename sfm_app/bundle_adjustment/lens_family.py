"""A camera as one of another family: a wide perspective lens as a fisheye, and back.

Ours. A perspective lens with strong distortion is often a fisheye. Which of the two it is, the photos say: both are
adjusted to the same observations, and their evidence is compared (`family_evidence`).
"""

import numpy as np
from numpy.typing import NDArray

from sfm_app.bundle_adjustment.lens_evidence import LensChoice, evidence_weight
from sfm_app.geometry.lenses.projections import (
    CAMERA,
    CX,
    CY,
    FISHEYE,
    FX,
    FY,
    K1,
    K2,
    K3,
    K4,
    PANORAMA,
    PERSPECTIVE,
    angle_limit,
    radius_at,
)

FloatArray = NDArray[np.float64]

SQUEEZE = 0.8
"""Share of the undistorted radius at which a perspective lens puts the outermost observations, below which it is tried
as a fisheye: at 120 degrees an equidistant lens has 0.6, and at 95 degrees 0.76. Chosen by hand; not measured on its
own."""
NARROW_ANGLE = np.radians(65.0)
"""Largest angle to the optical axis up to which a fisheye is tried as a perspective lens. Chosen by hand; not measured
on its own."""
SAMPLES = 200
"""Radii at which a lens is made like another. Chosen by hand; not measured on its own."""
LEAST_REACH = 0.2
"""Smallest share of the observed radius up to which a lens must not fold to be tried as another. Chosen by hand; not
measured on its own."""


def asks_for_other_family(params: FloatArray, family: int, reach: float, best: LensChoice, folding: bool) -> bool:
    """Return whether a camera is to be tried as one of the other family.

    A perspective lens is, if it needs many terms, would fold, or puts the outermost points far inwards. A fisheye is,
    if its view is so narrow that a perspective lens can show it.

    Args:
        params: (12,) of the camera.
        family: of the camera.
        reach: radius of the outermost observations, in focal lengths.
        best: its most probable model.
        folding: whether a more probable lens folds inside the photo.
    """
    if family == PANORAMA:
        return False
    angle = angle_limit(params, family, reach)
    if family == FISHEYE:
        return bool(angle < NARROW_ANGLE)
    return folding or "k3" in best.free or bool(np.isnan(angle) or reach < SQUEEZE * np.tan(angle))


def convert_lens(params: FloatArray, family: int, reach: float) -> FloatArray | None:
    """Return the camera (12,) of the other family that shows rays at nearly the same radius; None if there is none.

    Center and aspect are kept, and tangential terms are dropped.

    Args:
        params: (12,) of the camera.
        family: PERSPECTIVE or FISHEYE.
        reach: radius up to which the two agree, in focal lengths.
    """
    for share in np.linspace(1.0, LEAST_REACH, 9):
        angle = angle_limit(params, family, float(share * reach))
        if np.isfinite(angle):
            break
    else:
        return None
    angles = np.linspace(0.0, angle, SAMPLES + 1)[1:]
    places, base = ((K1, K2, K3, K4), angles) if family == PERSPECTIVE else ((K1, K2, K3), np.tan(angles))
    terms = base[:, None] ** (2 * np.arange(len(places) + 1) + 1)
    size = np.linalg.norm(terms, axis=0)
    found = np.linalg.lstsq(terms / size, radius_at(angles, params, family), rcond=1e-10)[0] / size
    if not found[0] > 0.0:
        return None
    other = np.zeros(CAMERA)
    other[[FX, FY, CX, CY]] = params[[FX, FY, CX, CY]]
    other[[FX, FY]] *= found[0]
    other[list(places)] = found[1:] / found[0]
    return other


def family_evidence(cost_px2: float, noise_px: float, best: LensChoice) -> float:
    """Return the log-probability of a bundle with one of its cameras as it is, comparable between families.

    Args:
        cost_px2: robust cost of the bundle.
        noise_px: the same for all that are compared.
        best: the camera's most probable model.
    """
    return best.log_evidence - evidence_weight(noise_px) * cost_px2
