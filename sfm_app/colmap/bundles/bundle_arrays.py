"""COLMAP's models as the arrays of our bundle adjustment, and back."""

from collections import Counter
from collections.abc import Mapping
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from sfm_app.bundle_adjustment.camera_rules import CameraRule
from sfm_app.bundle_adjustment.normal_equations import Bundle
from sfm_app.colmap.backend import pycolmap
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
    K5,
    K6,
    P1,
    P2,
    PANORAMA,
    PERSPECTIVE,
    SX,
    SY,
)

FloatArray = NDArray[np.float64]

PLACES = {
    "f": (FX, FY), "fx": (FX,), "fy": (FY,), "cx": (CX,), "cy": (CY,), "k": (K1,), "k1": (K1,), "k2": (K2,),
    "p1": (P1,), "p2": (P2,), "k3": (K3,), "k4": (K4,), "k5": (K5,), "k6": (K6,), "sx1": (SX,), "sy1": (SY,),
}  # fmt: skip
"""Indices in `Bundle.params` by COLMAP's names of parameters."""
OPENCV = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2")
FILE_MODELS = {
    PERSPECTIVE: {"OPENCV": OPENCV, "FULL_OPENCV": (*OPENCV, "k3", "k4", "k5", "k6")},
    FISHEYE: {
        "OPENCV_FISHEYE": ("fx", "fy", "cx", "cy", "k1", "k2", "k3", "k4"),
        "THIN_PRISM_FISHEYE": (*OPENCV, "k3", "k4", "sx1", "sy1"),
    },
}
"""COLMAP's models that refined cameras are written as, with their parameters; the smaller one first."""
EQUIRECTANGULAR = "EQUIRECTANGULAR"
Rules = Mapping[int, CameraRule]
"""What the user laid down about cameras, by id; cameras without a rule are free."""
NO_RULES: Rules = MappingProxyType({})


def camera_family(camera: pycolmap.Camera) -> int:
    """Return the family of a camera, as in `Bundle`."""
    if camera.model.name == EQUIRECTANGULAR:
        return PANORAMA
    return FISHEYE if "FISHEYE" in camera.model.name else PERSPECTIVE


def read_camera(camera: pycolmap.Camera) -> FloatArray:
    """Return the parameters (12,) of a camera, as in `Bundle`."""
    params = np.zeros(CAMERA)
    if camera_family(camera) == PANORAMA:
        width, height = camera.width, camera.height
        params[[FX, FY, CX, CY]] = width / (2.0 * np.pi), height / np.pi, width / 2.0, height / 2.0
        return params
    for name, value in zip(camera.params_info.split(", "), camera.params, strict=True):
        params[list(PLACES[name])] = value
    return params


def write_camera(camera: pycolmap.Camera, params: FloatArray, family: int) -> None:
    """Change a camera in place, to the smallest of FILE_MODELS that holds the values; a panorama stays as it is.

    Args:
        camera: COLMAP's camera.
        params: (12,) as in `Bundle`.
        family: of these parameters.
    """
    if family == PANORAMA:
        return
    name = file_model(params, family)
    camera.model = pycolmap.CameraModelId.__members__[name]
    camera.params = [float(params[PLACES[key][0]]) for key in FILE_MODELS[family][name]]


def file_model(params: FloatArray, family: int) -> str:
    """Return COLMAP's name of the model that a camera is written as.

    Args:
        params: (12,) as in `Bundle`.
        family: PERSPECTIVE or FISHEYE.
    """
    models = FILE_MODELS[family]
    for name, keys in models.items():
        rest = np.delete(params, [PLACES[key][0] for key in keys])
        if not rest.any():
            return name
    return list(models)[-1]


def read_bundle(model: pycolmap.Reconstruction, rules: Rules = NO_RULES) -> tuple[list[int], Bundle]:
    """Return the ids of the cameras in use, and the model as arrays.

    Args:
        model: COLMAP's reconstruction.
        rules: of some cameras, by id; those that are kept are fixed.
    """
    images = [model.images[image_id] for image_id in sorted(model.reg_image_ids())]
    ids, points = sorted(photos_per_camera(model)), sorted(model.points3D)
    rows = {point: row for row, point in enumerate(points)}
    seen = [image.get_observation_points2D() for image in images]
    fixed = np.array([camera_id in rules and rules[camera_id].kept for camera_id in ids], np.bool_)
    poses = np.array([image.cam_from_world().matrix() for image in images])
    return ids, Bundle(
        params=np.array([read_camera(model.cameras[camera_id]) for camera_id in ids]),
        camera=np.array([ids.index(image.camera_id) for image in images]),
        R=poses[:, :, :3],
        t=poses[:, :, 3],
        X=np.array([model.points3D[point].xyz for point in points], np.float64).reshape(-1, 3),
        photo=np.repeat(np.arange(len(images)), [len(one) for one in seen]),
        point=np.array([rows[keypoint.point3D_id] for one in seen for keypoint in one], np.int64),
        x=np.array([keypoint.xy for one in seen for keypoint in one], np.float64).reshape(-1, 2),
        family=np.array([camera_family(model.cameras[camera_id]) for camera_id in ids], np.int64),
        fixed=fixed if fixed.any() else None,
    )


def write_bundle(model: pycolmap.Reconstruction, ids: list[int], bundle: Bundle) -> None:
    """Write arrays into a model, in place.

    Args:
        model: COLMAP's reconstruction.
        ids: of the cameras, from `read_bundle`.
        bundle: with cameras, photos and points in the order of `read_bundle`.
    """
    for camera_id, params, family in zip(ids, bundle.params, bundle.family, strict=True):
        write_camera(model.cameras[camera_id], params, int(family))
    for image_id, R, t in zip(sorted(model.reg_image_ids()), bundle.R, bundle.t, strict=True):
        image = model.images[image_id]
        model.frames[image.frame_id].set_cam_from_world(image.camera_id, pycolmap.Rigid3d(pycolmap.Rotation3d(R), t))
    for point, xyz in zip(sorted(model.points3D), bundle.X, strict=True):
        model.points3D[point].xyz = xyz


def photos_per_camera(model: pycolmap.Reconstruction) -> Counter[int]:
    """Return the number of posed photos of each camera, by its id."""
    return Counter(model.images[image_id].camera_id for image_id in sorted(model.reg_image_ids()))
