"""COLMAP's sparse model as plain arrays."""

import numpy as np

from sfm_app.colmap.backend import pycolmap
from sfm_app.colmap.models.model import posed_images, scale_matrix
from sfm_app.types import SceneArrays


def model_arrays(model: pycolmap.Reconstruction, *, metric: bool) -> SceneArrays:
    """Return poses, cameras, points and tracks of a model.

    Args:
        model: COLMAP's reconstruction.
        metric: whether its unit is the meter.
    """
    images = sorted(posed_images(model), key=lambda image: image.name)
    cameras = [model.cameras[image.camera_id] for image in images]
    found = [model.points3D[key] for key in sorted(model.points3D)]
    rows = {image.image_id: row for row, image in enumerate(images)}
    keypoints = [np.array([point.xy for point in image.points2D], np.float64).reshape(-1, 2) for image in images]
    seen = [
        (row, rows[member.image_id], member.point2D_idx)
        for row, point in enumerate(found)
        for member in point.track.elements
        if member.image_id in rows
    ]
    point, photo, keypoint = np.array(seen, np.int64).reshape(-1, 3).T
    starts = np.cumsum([0, *map(len, keypoints)])
    pixels = np.concatenate([*keypoints, np.zeros((0, 2))])[starts[photo] + keypoint]
    poses = [image.cam_from_world().matrix() for image in images]
    return SceneArrays(
        photos=tuple(image.name for image in images),
        cam_from_world=np.array(poses, np.float64).reshape(-1, 3, 4),
        K=np.array([scale_matrix(camera) for camera in cameras], np.float64).reshape(-1, 3, 3),
        sizes=np.array([(camera.width, camera.height) for camera in cameras], np.int64).reshape(-1, 2),
        points=np.array([point.xyz for point in found], np.float64).reshape(-1, 3),
        colors=np.array([point.color for point in found], np.uint8).reshape(-1, 3),
        errors_px=np.array([point.error for point in found], np.float64),
        track_points=point,
        track_photos=photo,
        track_pixels=pixels,
        metric=metric,
    )
