"""Measure the readout of a rolling shutter on a model, and compensate its keypoints.

A compensated keypoint is where a global shutter at the time of the middle row would see its point.
"""

from collections.abc import Mapping

import numpy as np

from sfm_app.bundle.lens_parts import PARTS
from sfm_app.bundle.normal_equations import Bundle
from sfm_app.bundle.rolling_shutter import ReadoutEstimate, Rows, estimate_readout, move_to_middle_row
from sfm_app.camera.projection import image_points
from sfm_app.colmap.backend import Camera, Reconstruction, pycolmap
from sfm_app.colmap.bundle import Adjustment, lens_priors, read_bundle, write_bundle
from sfm_app.colmap.model import posed_images, viewing_rays
from sfm_app.types.arrays import FloatArray, IndexArray

Keypoints = Mapping[int, FloatArray]
"""(N, 2) pixels, by photo id."""


def read_keypoints(model: Reconstruction) -> dict[int, FloatArray]:
    """Return the keypoints (N, 2) of all posed photos by id, in pixels."""
    return {i.image_id: np.array([p.xy for p in i.points2D], np.float64).reshape(-1, 2) for i in posed_images(model)}


def measure_readout(
    adjusted: Adjustment, keypoints: Keypoints, times: Mapping[int, float],
    start: ReadoutEstimate | None = None, *, known: float | None = None,
) -> ReadoutEstimate:  # fmt: skip
    """Estimate the readout of the shutter from a model and uncompensated keypoints, at distinct times.

    The model has five or more photos, and no panorama; `start` and `known` are as of `estimate_readout`.
    """
    model = adjusted.model
    ids, bundle = read_bundle(model)
    images = posed_images(model)
    tracked = [keypoints[image.image_id][_tracked_rows(image)] for image in images]
    share = [row_shares(x, model.cameras[image.camera_id]) for image, x in zip(images, tracked, strict=True)]
    rows = Rows(np.array([times[image.image_id] for image in images], np.float64), np.concatenate(share))
    freed = [
        [part.name in adjusted.lenses[camera_id].chosen.free for part in PARTS[int(family)]]
        for camera_id, family in zip(ids, bundle.family, strict=True)
    ]
    uncompensated = Bundle(
        bundle.params, bundle.camera, bundle.R, bundle.t, bundle.X, bundle.photo, bundle.point,
        np.concatenate(tracked), bundle.family,
    )  # fmt: skip
    priors = lens_priors(model, ids, uncompensated)
    return estimate_readout(uncompensated, rows, priors, np.array(freed), start, known=known)


def straighten_model(model: Reconstruction, estimate: ReadoutEstimate, keypoints: Keypoints) -> Reconstruction:
    """Return a copy of a model with the estimate's poses, points and cameras, and with compensated keypoints."""
    model = Reconstruction(model)
    ids, _ = read_bundle(model)
    write_bundle(model, ids, estimate.bundle)
    for row, image in enumerate(posed_images(model)):
        moved = _compensate(model, image, keypoints[image.image_id], estimate, row)
        for keypoint, xy in zip(image.points2D, moved, strict=True):
            keypoint.xy = xy
    model.update_point_3d_errors()
    return model


def row_shares(x: FloatArray, camera: Camera) -> FloatArray:
    """Return the shares (N,) of the rows of keypoints (N, 2); rows are read along the shorter side of the sensor."""
    upright = camera.height > camera.width
    return np.asarray(x[:, 0] / camera.width - 0.5 if upright else x[:, 1] / camera.height - 0.5, np.float64)


def _tracked_rows(image: pycolmap.Image) -> IndexArray:
    """Return the indices of the keypoints that have a point in space, in order."""
    return np.flatnonzero([keypoint.has_point3D() for keypoint in image.points2D])


def _compensate(
    model: Reconstruction, image: pycolmap.Image, x: FloatArray, estimate: ReadoutEstimate, row: int
) -> FloatArray:
    """Return the compensated keypoints (N, 2) of a photo; unchanged if it sees no point."""
    from scipy.spatial import cKDTree

    tracked = _tracked_rows(image)
    if not len(tracked):
        return x
    camera, bundle = model.cameras[image.camera_id], estimate.bundle
    R, t, motion = bundle.R[row], bundle.t[row], estimate.motion[row]
    xyz = np.array([model.points3D[image.points2D[k].point3D_id].xyz for k in tracked])
    share = row_shares(x, camera)
    rays = viewing_rays(model, image.image_id, x) @ R.T
    rays /= np.linalg.norm(rays, axis=1)[:, None]
    known = 1.0 / np.linalg.norm(xyz @ R.T + t, axis=1)
    # untracked keypoints take the mean of their five nearest tracked ones
    _, near = cKDTree(x[tracked]).query(x, k=np.arange(1, min(5, len(tracked)) + 1))
    inverse = np.asarray(known[near].mean(axis=1), np.float64)
    inverse[tracked] = known
    middle = move_to_middle_row(rays / inverse[:, None], share, motion)
    place = int(bundle.camera[row])
    moved = image_points(middle, bundle.params[place], int(bundle.family[place]))
    shown = np.isfinite(moved).all(axis=1, keepdims=True)
    return np.where(shown, moved, x)
