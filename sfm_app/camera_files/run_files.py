"""Cameras of earlier runs: calibration.json, scene.json, and what `sfm-app calibrate --json` prints.

Only cameras that the photos of that run determined are used; the others were guesses.
"""

from collections.abc import Mapping
from dataclasses import fields, replace
from typing import Any

import numpy as np

from sfm_app.geometry.lenses.camera_models import calibration_from_model
from sfm_app.numerical import finite_entries
from sfm_app.types import Calibration
from sfm_app.types.calibration import GIVEN, PROJECTIONS

FIELDS = {field.name for field in fields(Calibration)}


def is_run_file(values: Mapping[str, Any]) -> bool:
    """Return whether the values are those of calibration.json or scene.json."""
    return "cameras" in values and "camera_of" in values


def run_file_cameras(values: Mapping[str, Any]) -> tuple[dict[str, Calibration], dict[str, str]]:
    """Return the cameras of calibration.json or scene.json that are known, and the camera of each photo.

    Raises:
        ValueError: the values are no cameras.
    """
    found = {str(name): run_camera(entry) for name, entry in values["cameras"].items()}
    cameras = {name: camera for name, camera in found.items() if camera is not None}
    return cameras, {str(photo): str(name) for photo, name in values["camera_of"].items()}


def is_run_camera(values: Mapping[str, Any]) -> bool:
    """Return whether the values are those of one camera of a run."""
    return "K" in values and ("identifiable" in values or "params" in values)


def run_camera(values: Mapping[str, Any]) -> Calibration | None:
    """Return a camera of a run, as one that the user gave; None where the photos did not determine it.

    Args:
        values: a `Calibration`, or a `CameraModel` after bundle adjustment, as plain values.

    Raises:
        ValueError: they are no camera.
    """
    if "params" in values:
        size = int(values["width"]), int(values["height"])
        found = calibration_from_model(str(values["model"]), values["params"], size)
        spread, correlations = (finite_entries(values.get(name, {})) for name in ("deviations", "correlations"))
        return replace(found, spread=spread, correlations=correlations)
    if not values["identifiable"]:
        return None
    known = {name: value for name, value in values.items() if name in FIELDS}
    found = Calibration.from_dict({"evidence": {}, **known, "held": (), "key_pairs": (), "method": GIVEN})
    if found.projection not in PROJECTIONS or found.K.shape != (3, 3) or not min(np.diag(found.K)) > 0.0:
        raise ValueError("its values are not those of a camera")
    if not np.isfinite([*found.K.ravel(), found.radial, *found.fisheye, *found.distortion]).all():
        raise ValueError("its values are not those of a camera")
    return replace(found, evidence={})
