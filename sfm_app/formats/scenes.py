"""Cameras, photos and clouds for other programs."""

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from sfm_app.camera.models import PARAMETERS, projection_of_model, row_of_model
from sfm_app.camera.rows import K1
from sfm_app.errors import InputError
from sfm_app.files import replace_atomically
from sfm_app.formats.exporters import FinishedScene
from sfm_app.formats.gltf import opengl_pose
from sfm_app.formats.meshes import cloud_ply
from sfm_app.numerical import json_text
from sfm_app.types import CameraModel, Scene
from sfm_app.types.arrays import FloatArray
from sfm_app.types.camera import EQUIRECTANGULAR, FISHEYE
from sfm_app.types.scene import PerspectivePhoto, camera_center

# Names of files that every program can read.

UNSAFE = re.compile(r"[^A-Za-z0-9-]+")
"""Characters that break trainers: they cut names at the first dot or blank, drop folders, or read single bytes."""


def plain_names(names: Sequence[str]) -> list[str]:
    """Return a name of letters, digits, - and _ for each name, all different even where case does not count."""
    used, unique = set[str](), []
    for name in names:
        plain = stem = UNSAFE.sub("_", name).strip("_") or "_"
        number = 1
        while plain.lower() in used:
            number += 1
            plain = f"{stem}_{number}"
        used.add(plain.lower())
        unique.append(plain)
    return unique


# Cameras and poses as JSON, for programs of any kind; `sfm-app run --calibration` reads the cameras, too.

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
    """Write a JSON file with the cameras, their deviations, and the pose of each photo."""
    result = scene.scene
    photos = {
        name: {
            "camera": result.camera_of[name],
            "cam_from_world": pose.tolist(),
            "center": camera_center(pose).tolist(),
        }
        for name, pose in result.cam_from_world.items()
    }
    content = {
        "conventions": CONVENTIONS,
        "cameras": {
            name: camera.to_dict() | {"parameters": list(PARAMETERS.get(camera.model, ()))}
            for name, camera in result.cameras.items()
        },
        "camera_of": dict(result.camera_of),
        "photos": photos,
        "unregistered": dict(result.unregistered),
    }
    target.write_text(json_text(content), encoding="utf-8", newline="\n")


# COLMAP's folder layout of undistorted photos, which Gaussian-splatting trainers read, and Bundler's files.

MODEL = "sparse/0"


def write_colmap(
    scene: FinishedScene, target: Path, *, text: bool = False, centered: bool = False, place: str = MODEL
) -> None:
    """Write undistorted photos into a folder, and COLMAP's model, binary or as text, to a `place` in it.

    `centered` puts every optical center in the middle of its photo, since some trainers read the focal length only. A
    crop around the optical center would lose much of a cropped photo, so the photo is rotated instead, as if the camera
    had looked at its middle.
    """
    views = scene.perspective(centered=centered)
    views.write_photos(target)
    views.write_colmap(target / place, text=text)


def write_bundler(scene: FinishedScene, target: Path) -> None:
    """Write Bundler's file by COLMAP's own writer, the list of photos, and the photos, into a folder."""
    views = scene.perspective(centered=True)
    views.write_photos(target)
    views.write_bundle(target / "bundle.out")
    lines = "".join(f"images/{photo.name}\n" for photo in views.photos)
    (target / "list.txt").write_text(lines, encoding="ascii", newline="\n")


# The folder that nerfstudio trains from: transforms.json, photos, masks and the sparse points.
# Its cameras look along -z with y up. Its points and poses share a frame, which is that of the model; nerfstudio
# turns and scales both as it loads them. Every photo has a mask, or none has.

TRANSFORMS, POINTS = "transforms.json", "sparse_pc.ply"


def write_nerfstudio(scene: FinishedScene, target: Path) -> None:
    """Write transforms.json, the undistorted photos, their masks and the points into a folder."""
    views = scene.perspective()
    views.write_photos(target)
    (target / POINTS).write_bytes(cloud_ply(scene.points()))
    (target / TRANSFORMS).write_text(json_text(transforms(views.photos)), encoding="utf-8", newline="\n")


def transforms(photos: tuple[PerspectivePhoto, ...]) -> dict[str, Any]:
    """Return the content of transforms.json; intrinsics are at its top if all photos share them."""
    lenses = [intrinsics(photo) for photo in photos]
    shared = lenses[0] if all(lens == lenses[0] for lens in lenses) else {}
    frames = [({} if shared else lens) | frame(photo) for lens, photo in zip(lenses, photos, strict=True)]
    return {"camera_model": "OPENCV", **shared, "ply_file_path": POINTS, "frames": frames}


def intrinsics(photo: PerspectivePhoto) -> dict[str, float]:
    """Return the intrinsics of a photo by nerfstudio's names."""
    K = photo.K.tolist()
    pinhole = {"fl_x": K[0][0], "fl_y": K[1][1], "cx": K[0][2], "cy": K[1][2], "w": photo.width, "h": photo.height}
    return pinhole | dict.fromkeys(("k1", "k2", "p1", "p2"), 0.0)


def frame(photo: PerspectivePhoto) -> dict[str, Any]:
    """Return the file and the pose of a photo."""
    pose = opengl_pose(photo).tolist()
    entry: dict[str, Any] = {"file_path": f"images/{photo.name}", "transform_matrix": pose}
    return entry | ({"mask_path": f"masks/{photo.mask}"} if photo.mask else {})


# Cameras as OpenCV's YAML, one file per camera, with the poses of its photos.
# OpenCV counts pixels from the center of the first one, which is (0.5, 0.5) here.


def write_opencv(scene: FinishedScene, target: Path) -> None:
    """Write a YAML file into a folder for each camera that OpenCV has a model for; InputError if it has for none."""
    result = scene.scene
    files = dict(zip(result.cameras, plain_names(list(result.cameras)), strict=True))
    reasons = {}
    for name, camera in result.cameras.items():
        try:
            model, terms = opencv_lens(camera)
        except ValueError as err:
            reasons[name] = str(err)
            continue
        with replace_atomically(target / f"{files[name]}.yaml") as path:
            path.write_text(camera_yaml(name, camera, (model, terms), result), encoding="utf-8", newline="\n")
    lines = [f"camera {name} is left out: {reason}" for name, reason in reasons.items()]
    if len(reasons) == len(result.cameras):
        hint = "--format cameras writes cameras of every kind, --format colmap perspective views of the photos"
        raise InputError("; ".join(lines) or "the scene has no cameras", hint=hint)
    for line in lines:
        scene.say(line)


def opencv_lens(camera: CameraModel) -> tuple[str, FloatArray]:
    """Return OpenCV's name and coefficients of the lens, 8 or, of a fisheye, 4; ValueError if it has no such lens."""
    projection, terms = projection_of_model(camera.model), row_of_model(camera.model, camera.params)[K1:]
    if projection == EQUIRECTANGULAR:
        raise ValueError("OpenCV has no model of a panorama")
    if projection != FISHEYE:
        return "perspective", terms
    if terms[[2, 3, 6, 7]].any():
        raise ValueError("OpenCV's fisheye has no tangential and thin prism terms")
    return "fisheye", terms[[0, 1, 4, 5]]


def camera_yaml(name: str, camera: CameraModel, lens: tuple[str, FloatArray], scene: Scene) -> str:
    """Return the file of a camera as cv2.FileStorage writes it; `lens` is from `opencv_lens`."""
    import cv2

    K = camera.K.copy()
    K[:2, 2] -= 0.5
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
