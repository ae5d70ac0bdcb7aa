"""COLMAP's sparse model on disk, as a scene and as points with cameras."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TypedDict

import numpy as np

from sfm_app.colmap.backend import pycolmap, translate_errors
from sfm_app.colmap.models.model import finite_mask, move, posed_images, scale_matrix
from sfm_app.geometry.camera import camera_matrix
from sfm_app.geometry.similarity import Similarity
from sfm_app.numerical import finite_entries
from sfm_app.types import CameraModel, Frustum, Model, Scene, Surface

MIN_CONFIRMED_POINTS = 100
"""Points seen by three or more photos from which on their bounding box limits the scene."""


def read_model(model_dir: Path, frame: Similarity | None = None) -> pycolmap.Reconstruction:
    """Read a model on disk.

    Args:
        model_dir: COLMAP's model.
        frame: from its frame into the one that is wanted; None for its own.
    """
    with translate_errors("reading the sparse model"):
        model = pycolmap.Reconstruction(model_dir)
        if frame is not None:
            move(model, frame)
    return model


def sparse_model(model_dir: Path) -> Model:
    """Return the colored points of a model on disk, and its posed photos as frusta, in order of ids.

    No third photo confirms points that only two photos see. Wrong ones among them lie far away and would shrink the
    scene to a dot in a viewer, so points outside the bounding box of the confirmed points are left out.

    Raises:
        BackendError: it cannot be read.
    """
    model = read_model(model_dir)
    found = [model.points3D[key] for key in sorted(model.points3D) if finite_mask(model.points3D[key].xyz)]
    places = np.array([point.xyz for point in found], np.float64).reshape(-1, 3)
    colors = np.array([point.color for point in found], np.uint8).reshape(-1, 3)
    confirmed = np.array([point.track.length() > 2 for point in found], bool)
    if np.count_nonzero(confirmed) >= MIN_CONFIRMED_POINTS:
        low, high = places[confirmed].min(axis=0), places[confirmed].max(axis=0)
        inside = ((places >= low) & (places <= high)).all(axis=1)
        places, colors = places[inside], colors[inside]
    cameras = tuple(_frustum(image, model.cameras[image.camera_id]) for image in posed_images(model))
    return Model(Surface(places, np.zeros((0, 3), np.int64), colors), cameras=cameras)


def _frustum(image: pycolmap.Image, camera: pycolmap.Camera) -> Frustum:
    K, pose = scale_matrix(camera), image.cam_from_world().matrix()
    if camera.is_spherical():  # drawn as a view of 90 degrees to its front
        K = camera_matrix(camera.width / 2, camera.width / 2, camera.width / 2, camera.height / 2)
    return Frustum(image.name, K, np.asarray(pose, np.float64), camera.width, camera.height)


class RefinedCamera(TypedDict, total=False):
    """Facts about a refined camera that COLMAP's model does not hold; as in `CameraModel`."""

    deviations: Mapping[str, float | None]
    determined: Sequence[str]
    correlations: Mapping[str, float | None]


def read_scene(
    model_dir: Path, names: Mapping[str, str], unregistered: Mapping[str, str], refined: Mapping[str, RefinedCamera]
) -> Scene:
    """Read a model on disk as the scene that later stages use.

    Args:
        model_dir: COLMAP's model.
        names, unregistered: the name of its camera, by photo; the reason why it has no pose, by photo.
        refined: deviations, determined parameters and correlations, by camera; may lack cameras.
    """
    model = pycolmap.Reconstruction(model_dir)
    posed = posed_images(model)
    ids = {names[image.name]: image.camera_id for image in posed}
    return Scene(
        model_dir=model_dir,
        cam_from_world={image.name: np.asarray(image.cam_from_world().matrix(), np.float64) for image in posed},
        unregistered=dict(unregistered),
        cameras={name: _camera(model.cameras[key], refined.get(name, {})) for name, key in ids.items()},
        points=model.num_points3D(),
        observations=model.compute_num_observations(),
        mean_reprojection_px=float(model.compute_mean_reprojection_error()),
        camera_of={image.name: names[image.name] for image in posed},
    )


def _camera(camera: pycolmap.Camera, refined: RefinedCamera) -> CameraModel:
    K = scale_matrix(camera)
    params = tuple(float(value) for value in camera.params)
    deviations, determined = finite_entries(refined.get("deviations", {})), tuple(refined.get("determined", ()))
    correlations = finite_entries(refined.get("correlations", {}))
    return CameraModel(camera.model.name, params, K, camera.width, camera.height, deviations, determined, correlations)
