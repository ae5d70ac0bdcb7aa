"""Cameras and poses as JSON, for programs of any kind; `sfm-app run --calibration` reads the cameras, too."""

from pathlib import Path
from typing import Any

from sfm_app.formats.exporters import FinishedScene
from sfm_app.geometry.lenses.camera_models import PARAMETERS
from sfm_app.numerical import json_text
from sfm_app.types import CameraModel

CONVENTIONS = {
    "cam_from_world": "3 x 4 [R | t]: a point X of the world is R X + t in the camera; x right, y down, z forward",
    "center": "the camera's place in the world, -R' t",
    "pixels": "the center of the top left pixel is (0.5, 0.5)",
    "model, params": "COLMAP's camera models; names of the parameters in `parameters`",
    "K": "pixels; of a panorama, the scale at its middle",
    "deviations": "standard deviations of the parameters, in pixels where the parameter is",
    "determined": "parameters besides the focal length that the photos determine; others kept their values",
    "unregistered": "photos without a pose, with the reason",
}


def write_cameras(scene: FinishedScene, target: Path) -> None:
    """Write the cameras with their deviations, and the pose of each photo.

    Args:
        scene: the finished scene.
        target: JSON file.
    """
    found = scene.scene
    photos = {
        name: {
            "camera": found.camera_of[name],
            "cam_from_world": pose.tolist(),
            "center": (-pose[:, :3].T @ pose[:, 3]).tolist(),
        }
        for name, pose in found.cam_from_world.items()
    }
    content = {
        "conventions": CONVENTIONS,
        "cameras": {name: camera_entry(camera) for name, camera in found.cameras.items()},
        "camera_of": dict(found.camera_of),
        "photos": photos,
        "unregistered": dict(found.unregistered),
    }
    target.write_text(json_text(content), encoding="utf-8", newline="\n")


def camera_entry(camera: CameraModel) -> dict[str, Any]:
    """Return a camera as plain values, with the names of its parameters."""
    return camera.to_dict() | {"parameters": list(PARAMETERS.get(camera.model, ()))}
