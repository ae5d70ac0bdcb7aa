"""How far points of a photo lie from where a camera's lens puts them, as a radius about the optical center."""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from sfm_app.camera import bearings
from sfm_app.camera import rows as families
from sfm_app.camera.models import row_of_calibration
from sfm_app.camera.projection import image_points
from sfm_app.synthetic.cameras import Camera, pixel_rays
from sfm_app.types import Calibration
from sfm_app.types.camera import PERSPECTIVE

FloatArray = NDArray[np.float64]
Project = Callable[[FloatArray], FloatArray]
"""Points (N, 2) in pixels of rays (N, 3), NaN for rays that a camera cannot see."""
STEP = 16
"""Every so many pixels of the photo are asked."""
WORST_PERCENT = 100.0


def radius_error_percent(true: Camera, project: Project, center: FloatArray, reach_px: float) -> float:
    """Return the largest error of the radius, in percent of the photo's width, at most `WORST_PERCENT`.

    Args:
        true: the camera that took the photo.
        project: the camera that was found.
        center: (2,) its optical center in pixels.
        reach_px: only points of the photo within this distance of the true center count.
    """
    rays = pixel_rays(true).reshape(true.height, true.width, 3)[::STEP, ::STEP].reshape(-1, 3)
    x, y = np.meshgrid(np.arange(0, true.width, STEP) + 0.5, np.arange(0, true.height, STEP) + 0.5)
    radius = np.hypot(x - true.K[0, 2], y - true.K[1, 2]).ravel()
    counts = (radius <= reach_px) & np.isfinite(rays[:, 0])
    found = project(rays[counts]) - center
    with np.errstate(invalid="ignore"):
        errors = np.abs(np.hypot(*found.T) - radius[counts]) / true.width * 100.0
    return float(np.minimum(np.nan_to_num(errors, nan=WORST_PERCENT), WORST_PERCENT).max(initial=0.0))


def projection_of(camera: Calibration) -> Project:
    """Return how a calibration projects: any projection, and one radial term of a perspective lens."""
    if camera.projection != PERSPECTIVE:
        return lambda rays: bearings.project(rays, camera)

    def project(rays: FloatArray) -> FloatArray:
        return np.where(
            rays[:, 2:] > 1e-6, image_points(rays, row_of_calibration(camera), families.PERSPECTIVE), np.nan
        )

    return project
