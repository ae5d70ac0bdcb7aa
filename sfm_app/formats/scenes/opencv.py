"""Cameras as OpenCV's YAML, one file per camera, with the poses of its photos.

OpenCV counts pixels from the center of the first one, which is (0.5, 0.5) here.
"""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sfm_app.atomic_io import replace_atomically
from sfm_app.errors import InputError
from sfm_app.formats.exporters import FinishedScene
from sfm_app.formats.scenes.names import plain_names
from sfm_app.geometry.lenses.camera_models import calibration_from_model, distortion_terms
from sfm_app.types import CameraModel, Scene
from sfm_app.types.calibration import EQUIRECTANGULAR, FISHEYE

FIRST_PIXEL = 0.5
"""Our coordinates of the pixel that OpenCV calls (0, 0). By definition."""
FISHEYE_TERMS, OTHER_TERMS = [0, 1, 4, 5], [2, 3, 6, 7]
"""Of the eight terms of a fisheye, the four that OpenCV has, and the others."""


def write_opencv(scene: FinishedScene, target: Path) -> None:
    """Write a YAML file for each camera that OpenCV has a model for.

    Args:
        scene: the finished scene.
        target: folder to fill.

    Raises:
        InputError: OpenCV has a model for none of the cameras.
    """
    found = scene.scene
    files = dict(zip(found.cameras, plain_names(list(found.cameras)), strict=True))
    reasons = {}
    for name, camera in found.cameras.items():
        try:
            model, terms = opencv_lens(camera)
        except ValueError as err:
            reasons[name] = str(err)
            continue
        with replace_atomically(target / f"{files[name]}.yaml") as path:
            path.write_text(camera_yaml(name, camera, (model, terms), found), encoding="utf-8", newline="\n")
    lines = [f"camera {name} is left out: {reason}" for name, reason in reasons.items()]
    if len(reasons) == len(found.cameras):
        hint = "--format cameras writes cameras of every kind, --format colmap perspective views of the photos"
        raise InputError("; ".join(lines) or "the scene has no cameras", hint=hint)
    for line in lines:
        scene.say(line)


def opencv_lens(camera: CameraModel) -> tuple[str, NDArray[np.float64]]:
    """Return OpenCV's name of the lens, and its coefficients: k1 k2 p1 p2 k3 k4 k5 k6, or four of a fisheye.

    Args:
        camera: after bundle adjustment.

    Raises:
        ValueError: OpenCV has no such lens.
    """
    found = calibration_from_model(camera.model, camera.params, (camera.width, camera.height))
    if found.projection == EQUIRECTANGULAR:
        raise ValueError("OpenCV has no model of a panorama")
    terms = distortion_terms(found)
    if found.projection != FISHEYE:
        return "perspective", terms
    if terms[OTHER_TERMS].any():
        raise ValueError("OpenCV's fisheye has no tangential and thin prism terms")
    return "fisheye", terms[FISHEYE_TERMS]


def camera_yaml(name: str, camera: CameraModel, lens: tuple[str, NDArray[np.float64]], scene: Scene) -> str:
    """Return the file of a camera: what cv2.FileStorage writes.

    Args:
        name: of the camera.
        camera: after bundle adjustment.
        lens: from `opencv_lens`.
        scene: poses of the photos.
    """
    import cv2

    K = camera.K.copy()
    K[:2, 2] -= FIRST_PIXEL
    storage = cv2.FileStorage(".yaml", cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_MEMORY)
    storage.write("camera_name", name)
    storage.write("image_width", camera.width)
    storage.write("image_height", camera.height)
    storage.write("distortion_model", lens[0])
    storage.write("camera_matrix", K)
    storage.write("distortion_coefficients", lens[1].reshape(1, -1))
    storage.startWriteStruct("standard_deviations", cv2.FileNode_MAP)
    for key, value in camera.deviations.items():
        storage.write(key, float(value))
    storage.endWriteStruct()
    storage.startWriteStruct("photos", cv2.FileNode_SEQ)
    for photo, pose in scene.cam_from_world.items():
        if scene.camera_of[photo] == name:
            storage.startWriteStruct("", cv2.FileNode_MAP)
            storage.write("name", photo)
            storage.write("rvec", cv2.Rodrigues(pose[:, :3])[0])
            storage.write("tvec", pose[:, 3:].copy())
            storage.endWriteStruct()
    storage.endWriteStruct()
    return str(storage.releaseAndGetString())
