"""Cameras as OpenSfM writes them into camera_models.json, and OpenDroneMap into cameras.json.

Lengths are in units of the longer side, and the center counts from the middle of the photo.
"""

from collections.abc import Mapping
from typing import Any

from sfm_app.geometry.lenses.camera_models import calibration_from_model
from sfm_app.types import Calibration

MODELS = {
    "perspective": ("FULL_OPENCV", ("k1", "k2")),
    "simple_radial": ("FULL_OPENCV", ("k1",)),
    "radial": ("FULL_OPENCV", ("k1", "k2")),
    "brown": ("FULL_OPENCV", ("k1", "k2", "p1", "p2", "k3")),
    "fisheye": ("THIN_PRISM_FISHEYE", ("k1", "k2")),
    "fisheye_opencv": ("THIN_PRISM_FISHEYE", ("k1", "k2", "", "", "k3", "k4")),
}
"""By projection type: COLMAP's model of the same lens, and OpenSfM's names of its terms in COLMAP's order."""
PANORAMAS = ("spherical", "equirectangular")


def is_opensfm_camera(values: Mapping[str, Any]) -> bool:
    """Return whether the values name a projection type, as OpenSfM's do."""
    return "projection_type" in values


def opensfm_camera(values: Mapping[str, Any]) -> Calibration:
    """Return the camera of OpenSfM's values.

    Args:
        values: one entry of the file.

    Raises:
        ValueError: no run can use its projection type, or they are no camera.
    """
    kind = str(values["projection_type"]).lower()
    width, height = (int(values.get(name, 0)) for name in ("width", "height"))
    if width <= 0 or height <= 0:
        raise ValueError("it has no width and height")
    if kind in PANORAMAS:
        return calibration_from_model("EQUIRECTANGULAR", (width, height), (width, height))
    if kind not in MODELS:
        raise ValueError(f"the projection type {kind[:40]} cannot be used: only {', '.join((*MODELS, *PANORAMAS))}")
    if not values.get("focal_x", values.get("focal", 0.0)):
        raise ValueError("it has no focal length")
    side = float(max(width, height))
    fx, fy = (side * float(values.get(name, values.get("focal", 0.0))) for name in ("focal_x", "focal_y"))
    cx = side * float(values.get("c_x", 0.0)) + 0.5 * width
    cy = side * float(values.get("c_y", 0.0)) + 0.5 * height
    model, names = MODELS[kind]
    terms = [float(values.get(name, 0.0)) if name else 0.0 for name in names]
    return calibration_from_model(model, [fx, fy, cx, cy, *terms, *[0.0] * (8 - len(terms))], (width, height))
