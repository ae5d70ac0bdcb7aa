"""The model of undistorted photos at full size: every keypoint where it was found, seen through a pinhole."""

import threading
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sfm_app.colmap.backend import check_written, pycolmap, translate_errors
from sfm_app.colmap.models.model import finite_mask, posed_images
from sfm_app.colmap.wide_views import WideLens, add_view_cameras, perspective_lenses
from sfm_app.geometry.lenses.perspective_views import PerspectiveView, center_view
from sfm_app.types.exported import PerspectivePhoto, PointCloud

FULL_SIZE = 65_000
"""Longest side of a view in pixels, which no photo has: what JPEG can hold, rounded down."""

FloatArray = NDArray[np.float64]
ViewNames = Mapping[str, Sequence[str]]
"""Names of the views of each photo, by its name."""


def full_size_lenses(model: pycolmap.Reconstruction, *, centered: bool) -> dict[int, WideLens]:
    """Return the views of every camera at full size, by its id.

    Args:
        model: COLMAP's reconstruction.
        centered: whether the optical center of every view is in its middle, and its pixels are square.
    """
    with translate_errors("undistorting the cameras"):
        lenses = perspective_lenses(model, FULL_SIZE)
    if not centered:
        return lenses
    return {key: replace(lens, views=tuple(map(center_view, lens.views))) for key, lens in lenses.items()}


class PixelMaps:
    """Which pixels of a photo its views show, by camera; those of the camera asked for last are kept for its photos.

    Args:
        model: COLMAP's reconstruction.
        lenses: views by id of the camera.
    """

    def __init__(self, model: pycolmap.Reconstruction, lenses: Mapping[int, WideLens]) -> None:
        self._model, self._lenses, self._lock = model, lenses, threading.Lock()
        self._known: tuple[int, list[NDArray[np.float32]]] = (-1, [])

    def camera_maps(self, camera_id: int) -> list[NDArray[np.float32]]:
        """Return the pixels (H, W, 2) of each view, -1 where the photo does not show them."""
        with self._lock:
            if self._known[0] != camera_id:
                self._known = camera_id, self._compute(camera_id)
            return self._known[1]

    def _compute(self, camera_id: int) -> list[NDArray[np.float32]]:
        lens, camera = self._lenses[camera_id], self._model.cameras[camera_id]

        def project(rays: FloatArray) -> FloatArray:
            return np.nan_to_num(np.asarray(camera.img_from_cam(rays), np.float64), nan=-1.0)

        # COLMAP is many times faster, but does not know where a wide lens ends
        return [view.locate(project if len(lens.views) == 1 else lens.locate) for view in lens.views]


def perspective_photos(
    model: pycolmap.Reconstruction, lenses: Mapping[int, WideLens], names: ViewNames
) -> tuple[PerspectivePhoto, ...]:
    """Return the views of all posed photos, by name of the photo.

    Args:
        model: COLMAP's reconstruction.
        lenses: views by id of the camera.
        names: of the views.
    """
    return tuple(
        PerspectivePhoto(name, image.name, view.K, view.width, view.height, view.R @ image.cam_from_world().matrix())
        for image in sorted(posed_images(model), key=lambda image: image.name)
        for name, view in zip(names[image.name], lenses[image.camera_id].views, strict=True)
    )


def write_view_model(
    model: pycolmap.Reconstruction, lenses: Mapping[int, WideLens], names: ViewNames, folder: Path, *,
    text: bool = False,
) -> None:  # fmt: skip
    """Write COLMAP's model of the views.

    Args:
        model: COLMAP's reconstruction of the photos.
        lenses: views by id of the camera.
        names: of the views.
        folder: created.
        text: whether as text instead of binary.
    """
    folder.mkdir(parents=True, exist_ok=True)
    with translate_errors("writing the model of undistorted photos"):
        found = make_view_model(model, lenses, names)
        found.write_text(folder) if text else found.write(folder)
    check_written(*folder.iterdir())


def make_view_model(
    model: pycolmap.Reconstruction, lenses: Mapping[int, WideLens], names: ViewNames
) -> pycolmap.Reconstruction:
    """Return the model of the views; points keep their ids, and those that no view shows are left out.

    Args:
        model: COLMAP's reconstruction of the photos.
        lenses: views by id of the camera.
        names: of the views.
    """
    found = pycolmap.Reconstruction()
    cameras = add_view_cameras(found, lenses)
    tracks = {point: pycolmap.Track() for point in sorted(model.points3D)}
    for image in sorted(posed_images(model), key=lambda image: image.name):
        points, rays = tracked_rays(model, image)
        for number, view in enumerate(lenses[image.camera_id].views):
            x, shown = project_rays(rays, view)
            image_id = found.num_images() + 1
            for index, row in enumerate(shown):
                tracks[points[row]].add_element(image_id, index)
            camera_id = cameras[image.camera_id, number]
            added = pycolmap.Image(
                name=names[image.name][number], keypoints=x[shown], camera_id=camera_id, image_id=image_id
            )
            pose = pycolmap.Rigid3d(view.R @ image.cam_from_world().matrix())
            found.add_image_with_trivial_frame(added, pose)
    for point_id, track in tracks.items():
        if track.length():
            old = model.points3D[point_id]
            found.add_point3D_with_id(point_id, pycolmap.Point3D(xyz=old.xyz, color=old.color, track=track))
    found.update_point_3d_errors()
    return found


def tracked_rays(model: pycolmap.Reconstruction, image: pycolmap.Image) -> tuple[list[int], FloatArray]:
    """Return the points that a photo sees, by id, and the rays (N, 3) of their keypoints in its frame.

    Args:
        model: COLMAP's reconstruction.
        image: posed photo.
    """
    tracked = [point for point in image.points2D if point.has_point3D()]
    x = np.array([point.xy for point in tracked], np.float64).reshape(-1, 2)
    rays = np.asarray(model.cameras[image.camera_id].cam_ray_from_img(x), np.float64).reshape(-1, 3)
    return [point.point3D_id for point in tracked], rays


def project_rays(rays: FloatArray, view: PerspectiveView) -> tuple[FloatArray, NDArray[np.intp]]:
    """Return the pixels (N, 2) of rays in a view, and which rows are inside of it.

    Args:
        rays: (N, 3) in the photo's frame.
        view: the view.
    """
    at = rays @ view.R.T @ view.K.T
    with np.errstate(divide="ignore", invalid="ignore"):
        x = at[:, :2] / at[:, 2:]
    return x, np.flatnonzero((at[:, 2] > 0.0) & np.all((x >= 0.0) & (x <= [view.width, view.height]), axis=1))


def all_points(model: pycolmap.Reconstruction) -> PointCloud:
    """Return the finite points of a model, in order of ids."""
    found = [model.points3D[key] for key in sorted(model.points3D) if finite_mask(model.points3D[key].xyz)]
    return PointCloud(
        np.array([point.xyz for point in found], np.float64).reshape(-1, 3),
        np.array([point.color for point in found], np.uint8).reshape(-1, 3),
    )
