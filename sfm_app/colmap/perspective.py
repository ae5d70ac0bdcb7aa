"""Undistorted perspective photos for export and refinement: their model, larger ones, and Bundler's file."""

import shutil
import threading
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import cv2
import numpy as np

from sfm_app.camera.perspective_views import PerspectiveView, center_view
from sfm_app.camera.rows import FX
from sfm_app.colmap import tasks, wide_views
from sfm_app.colmap.backend import Reconstruction, check_written, pycolmap, translate_errors
from sfm_app.colmap.model import finite_points, point_arrays, posed_images
from sfm_app.colmap.worker_process import run_worker
from sfm_app.meshing.agreement import RefinePhoto
from sfm_app.operating_system import replace_file
from sfm_app.progress import Progress
from sfm_app.stereo import View
from sfm_app.types.arrays import Float32Array, FloatArray
from sfm_app.types.scene import PerspectivePhoto, PointCloud


def full_size_lenses(model: Reconstruction, *, centered: bool) -> dict[int, wide_views.WideLens]:
    """Return the views of every camera at full size, by id; `centered` ones have square pixels and a central axis."""
    with translate_errors("undistorting the cameras"):
        lenses = wide_views.perspective_lenses(model, 65_000)  # pixels: what JPEG can hold, rounded down
    if not centered:
        return lenses
    return {key: replace(lens, views=tuple(map(center_view, lens.views))) for key, lens in lenses.items()}


class PixelMaps:
    """Pixels of a photo that its views show, by camera; those of the last camera are kept for its other photos."""

    def __init__(self, model: Reconstruction, lenses: Mapping[int, wide_views.WideLens]) -> None:
        self._model, self._lenses, self._lock = model, lenses, threading.Lock()
        self._known: tuple[int, list[Float32Array]] = (-1, [])

    def camera_maps(self, camera_id: int) -> list[Float32Array]:
        """Return the pixels (H, W, 2) of each view, -1 where the photo does not show them."""
        with self._lock:
            if self._known[0] != camera_id:
                self._known = camera_id, self._compute(camera_id)
            return self._known[1]

    def _compute(self, camera_id: int) -> list[Float32Array]:
        lens, camera = self._lenses[camera_id], self._model.cameras[camera_id]

        def project(rays: FloatArray) -> FloatArray:
            return np.nan_to_num(np.asarray(camera.img_from_cam(rays), np.float64), nan=-1.0)

        # COLMAP is many times faster, but does not know the border of a wide lens
        return [view.locate(project if len(lens.views) == 1 else lens.locate) for view in lens.views]


def perspective_photos(
    model: Reconstruction, lenses: Mapping[int, wide_views.WideLens], names: wide_views.ViewNames
) -> tuple[PerspectivePhoto, ...]:
    """Return the views of all posed photos, by name of the photo."""
    return tuple(
        PerspectivePhoto(name, view.K, view.R @ image.cam_from_world().matrix(), view.width, view.height, image.name)
        for image in sorted(posed_images(model), key=lambda image: image.name)
        for name, view in zip(names[image.name], lenses[image.camera_id].views, strict=True)
    )


def write_view_model(
    model: Reconstruction, lenses: Mapping[int, wide_views.WideLens], names: wide_views.ViewNames, folder: Path, *,
    text: bool = False,
) -> None:  # fmt: skip
    """Write COLMAP's model of the views into a new or existing folder, as text or binary."""

    def keypoint_rays(image: pycolmap.Image, tracked: Sequence[pycolmap.Point2D]) -> FloatArray:
        pixels = np.array([point.xy for point in tracked], np.float64).reshape(-1, 2)
        return np.asarray(model.cameras[image.camera_id].cam_ray_from_img(pixels), np.float64).reshape(-1, 3)

    folder.mkdir(parents=True, exist_ok=True)
    with translate_errors("writing the model of undistorted photos"):
        view_model = wide_views.make_view_model(model, lenses, names, keypoint_rays)
        view_model.write_text(folder) if text else view_model.write(folder)
    check_written(*folder.iterdir())


def all_points(model: Reconstruction) -> PointCloud:
    """Return the finite points of a model, in order of ids."""
    return PointCloud(*point_arrays(finite_points(model)))


class LargerViews:
    """Undistorts the photos of a dense workspace again, at another size, but no larger than the photo."""

    def __init__(
        self, model_dir: Path, photo_dir: Path, mask_dir: Path | None, views: Sequence[View], max_side_px: int
    ) -> None:
        self._photo_dir, self._mask_dir = photo_dir, mask_dir
        with translate_errors("reading the model"):
            model = Reconstruction(model_dir)
            lenses = wide_views.perspective_lenses(model, max_side_px)
            images = {image.name: image for image in posed_images(model)}
        parts: dict[int, dict[int, PerspectiveView]] = {}
        self._camera, self._poses = dict[str, int](), dict[str, dict[int, View]]()
        for view in views:
            # a single view has the name of its photo
            name, number = (view.name, 0) if view.name in images else wide_views.parse_view_name(view.name)
            image = images[name]
            R = view.R @ image.cam_from_world().matrix()[:, :3].T
            larger = _resize(view, float(lenses[image.camera_id].params[FX]), max_side_px)
            part = PerspectiveView(R, larger.K, larger.width, larger.height)
            parts.setdefault(image.camera_id, {}).setdefault(number, part)
            self._camera[name] = image.camera_id
            self._poses.setdefault(name, {})[number] = larger
        self._order = {key: sorted(numbers) for key, numbers in parts.items()}
        self._lenses = {
            key: replace(lenses[key], views=tuple(parts[key][k] for k in order)) for key, order in self._order.items()
        }
        self._maps = PixelMaps(model, self._lenses)

    @property
    def photos(self) -> list[str]:
        """Names of the photos, those of the same camera together: they show the same pixels."""
        return sorted(self._camera, key=lambda photo: (self._camera[photo], photo))

    def render(self, photo: str) -> Iterator[RefinePhoto]:
        """Yield the views of a photo."""
        camera_id, poses = self._camera[photo], self._poses[photo]
        lens, maps = self._lenses[camera_id], self._maps.camera_maps(camera_id)
        with translate_errors(f"reading {photo}"):
            pictures = wide_views.render_views(photo, lens, self._photo_dir, self._mask_dir, maps)
            for number, (pixels, shown) in zip(self._order[camera_id], pictures, strict=True):
                if number in poses:
                    gray = np.asarray(cv2.cvtColor(pixels, cv2.COLOR_BGR2GRAY), np.uint8)
                    yield RefinePhoto(poses[number], gray, None if shown.all() else ~shown)


def _resize(view: View, focal_px: float, max_side_px: int) -> View:
    """Return a view in the resolution of its photo, or smaller if its longest side is limited."""
    scale = min(max_side_px / max(view.width, view.height), focal_px / float(view.K[0, 0]))
    return view.resize(max(1, round(scale * view.width)), max(1, round(scale * view.height)))


def write_bundle(model_dir: Path, photo_dir: Path, file: Path, workers: int, progress: Progress) -> None:
    """Write the cameras, poses and points of a model for Bundler; COLMAP also writes photos, which are thrown away.

    The model has one focal per camera, and optical centers in the middle.
    """
    scratch = file.with_name(".pmvs")
    try:
        scratch.mkdir()
        any_size = -1
        call = partial(tasks.undistort, scratch, model_dir, photo_dir, any_size, workers, layout="PMVS")
        run_worker(call, "writing Bundler's file", progress)
        replace_file(scratch / "pmvs/bundle.rd.out", file)
    finally:
        shutil.rmtree(scratch, ignore_errors=True)
