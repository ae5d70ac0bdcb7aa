"""Photos of wide lenses in COLMAP's dense workspace, as several perspective views if one would lose too much."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from sfm_app.camera.perspective_views import PerspectiveView, cover_rays
from sfm_app.camera.projection import SEEN_ANGLE, image_points
from sfm_app.camera.rows import FISHEYE, FX, PANORAMA
from sfm_app.colmap.backend import Camera, Reconstruction, pycolmap, translate_errors
from sfm_app.colmap.dense import MASKS, shrink_mask
from sfm_app.colmap.model import camera_family, posed_images, read_camera
from sfm_app.colmap.tasks import JPEG_QUALITY
from sfm_app.files import replace_atomically
from sfm_app.photos.masks import read_mask, save_mask
from sfm_app.photos.panoramas import resample, shrink
from sfm_app.types.arrays import BoolArray, ByteArray, Float32Array, FloatArray

ViewNames = Mapping[str, Sequence[str]]
"""Names of the views of each photo, by its name."""
RaysOfKeypoints = Callable[[pycolmap.Image, Sequence[pycolmap.Point2D]], FloatArray]
"""Returns the rays (N, 3) of keypoints of a photo in the camera's frame, of any length."""


@dataclass(frozen=True, slots=True, eq=False)
class WideLens:
    """A camera, with the perspective views that show its photos."""

    params: FloatArray
    """(12,) as in `camera.projection`."""
    family: int
    size: tuple[int, int]
    """(width, height) of its photos."""
    least_cosine: float
    """Cosine of the largest angle to the optical axis that the photos show."""
    views: tuple[PerspectiveView, ...]

    def locate(self, rays: FloatArray) -> FloatArray:
        """Return the pixels (N, 2) of rays (N, 3) of the camera's frame; -1 for rays that the photos do not show."""
        x = image_points(rays, self.params, self.family)
        shown = rays[:, 2] >= self.least_cosine * np.linalg.norm(rays, axis=1)
        shown &= np.all((x >= 0.0) & (x <= self.size), axis=1)
        return np.where(shown[:, None], x, -1.0)


def split_wide_photos(model_dir: Path, max_side_px: int) -> dict[int, WideLens] | None:
    """Return the perspective views of every camera, by its id; None if COLMAP's single view is enough for each."""
    with translate_errors("reading the model"):
        model = Reconstruction(model_dir)
        if all(view is not None for view in _single_views(model, max_side_px).values()):
            return None
        return perspective_lenses(model, max_side_px)


def perspective_lenses(model: Reconstruction, max_side_px: int) -> dict[int, WideLens]:
    """Return the perspective views of every camera with posed photos, by its id; one view where that is enough."""
    single = _single_views(model, max_side_px)
    return {key: _make_lens(model.cameras[key], view, max_side_px) for key, view in single.items()}


def _single_views(model: Reconstruction, max_side_px: int) -> dict[int, PerspectiveView | None]:
    """Return the single view of every camera with posed photos, by its id; None where one loses too much."""
    used = sorted({image.camera_id for image in posed_images(model)})
    return {camera_id: _one_view(model.cameras[camera_id], max_side_px) for camera_id in used}


def view_name(photo: str, number: int) -> str:
    """Return the name of a view in the dense workspace; its number is that in `WideLens.views`."""
    return f"{photo}.{number + 1}.jpg"


def parse_view_name(name: str) -> tuple[str, int]:
    """Return the photo and the number of a view; the reverse of `view_name`."""
    photo, number, _ = name.rsplit(".", 2)
    return photo, int(number) - 1


def write_model(model_dir: Path, lenses: Mapping[int, WideLens], dense_dir: Path) -> list[tuple[str, int]]:
    """Write the model of all views into a dense workspace; return the name and the camera's id of each photo."""
    with translate_errors("writing the model of perspective views"):
        model = Reconstruction(model_dir)
        photos = {image.name: image.camera_id for image in sorted(posed_images(model), key=lambda image: image.name)}
        names = {n: [view_name(n, k) for k in range(len(lenses[c].views))] for n, c in photos.items()}

        def points_in_camera(image: pycolmap.Image, tracked: Sequence[pycolmap.Point2D]) -> FloatArray:
            pose = image.cam_from_world().matrix()
            X = np.array([model.points3D[point.point3D_id].xyz for point in tracked], np.float64).reshape(-1, 3)
            return np.asarray(X @ pose[:, :3].T + pose[:, 3])

        (dense_dir / "sparse").mkdir(parents=True, exist_ok=True)
        make_view_model(model, lenses, names, points_in_camera).write(dense_dir / "sparse")
        return list(photos.items())


def make_view_model(
    model: Reconstruction, lenses: Mapping[int, WideLens], names: ViewNames, rays_of: RaysOfKeypoints
) -> Reconstruction:
    """Return the model of the views; points keep their ids, and points that no view shows are left out."""
    view_model = Reconstruction()
    cameras = _add_view_cameras(view_model, lenses)
    tracks = {point: pycolmap.Track() for point in sorted(model.points3D)}
    for image in sorted(posed_images(model), key=lambda image: image.name):
        tracked = [point for point in image.points2D if point.has_point3D()]
        rays = rays_of(image, tracked)
        for number, view in enumerate(lenses[image.camera_id].views):
            x, is_shown = _project(rays, view)
            shown = np.flatnonzero(is_shown)
            image_id = view_model.num_images() + 1
            for index, row in enumerate(shown):
                tracks[tracked[row].point3D_id].add_element(image_id, index)
            camera_id = cameras[image.camera_id, number]
            added = pycolmap.Image(
                name=names[image.name][number], keypoints=x[shown], camera_id=camera_id, image_id=image_id
            )
            pose = pycolmap.Rigid3d(view.R @ image.cam_from_world().matrix())
            view_model.add_image_with_trivial_frame(added, pose)
    for point_id, track in tracks.items():
        if track.length():
            old = model.points3D[point_id]
            view_model.add_point3D_with_id(point_id, pycolmap.Point3D(xyz=old.xyz, color=old.color, track=track))
    view_model.update_point_3d_errors()
    return view_model


def write_views(name: str, lens: WideLens, photo_dir: Path, mask_dir: Path | None, dense_dir: Path) -> None:
    """Write the views of a photo, and masks of views with pixels that it does not show or that are masked."""
    with translate_errors(f"reading {name}"):
        for number, (pixels, shown) in enumerate(render_views(name, lens, photo_dir, mask_dir)):
            save_picture(dense_dir / "images" / view_name(name, number), pixels)
            if not shown.all():
                save_mask(dense_dir / MASKS, view_name(name, number), shrink_mask(shown))


def render_views(
    name: str, lens: WideLens, photo_dir: Path, mask_dir: Path | None, maps: Sequence[Float32Array] = ()
) -> Iterator[tuple[ByteArray, BoolArray]]:
    """Yield each view of a photo, (H, W, 3) BGR, and the mask (H, W) of pixels that it shows and nothing masks.

    `maps` (H, W, 2) are the pixels of the photo that each view shows, -1 where it shows none; empty if not known.
    """
    photo = np.asarray(cv2.imdecode(np.fromfile(photo_dir / name, np.uint8), cv2.IMREAD_COLOR), np.uint8)
    used = None if mask_dir is None else read_mask(mask_dir, name)
    for number, view in enumerate(lens.views):
        pixels = maps[number] if maps else view.locate(lens.locate)
        shown = pixels[..., 0] >= 0.0
        small = shrink(photo, view.K[0, 0] / lens.params[FX])
        if used is not None:
            row, column = (np.minimum(pixels[..., axis].astype(np.int64), lens.size[axis] - 1) for axis in (1, 0))
            shown &= used[row, column]
        yield resample(small, pixels, lens.size, wraps=lens.family == PANORAMA), shown


def save_picture(target: Path, pixels: ByteArray) -> None:
    """Write a picture (H, W, 3) BGR as JPEG, as a whole or not at all; its folder is created."""
    with replace_atomically(target) as path:
        path.write_bytes(cv2.imencode(".jpg", pixels, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])[1].tobytes())


def _one_view(camera: Camera, max_side_px: int) -> PerspectiveView | None:
    """Return COLMAP's undistorted photo of a camera; None if it loses more than a tenth of the photo."""
    rays = _shown_rays(camera)
    if camera_family(camera) == PANORAMA or not len(rays):
        return None
    options = pycolmap.UndistortCameraOptions()
    options.max_image_size = max_side_px
    flat = pycolmap.undistort_camera(options, camera)
    view = PerspectiveView(np.eye(3), np.array(flat.calibration_matrix()), flat.width, flat.height)
    return view if np.mean(_project(rays, view)[1]) >= 1.0 - 0.1 else None


def _project(rays: FloatArray, view: PerspectiveView) -> tuple[FloatArray, BoolArray]:
    """Return the pixels (N, 2) of rays (N, 3) in a view, and (N,) whether it shows them."""
    projected = rays @ view.R.T @ view.K.T
    with np.errstate(divide="ignore", invalid="ignore"):
        x = projected[:, :2] / projected[:, 2:]
    return x, (projected[:, 2] > 0.0) & np.all((x >= 0.0) & (x <= [view.width, view.height]), axis=1)


def _make_lens(camera: Camera, single: PerspectiveView | None, max_side_px: int) -> WideLens:
    """Return a camera with the views of its photos: the single one, or several."""
    rays, params = _shown_rays(camera), read_camera(camera)
    views = [single] if single is not None else cover_rays(rays, float(params[FX]), max_side_px)
    least = float(rays[:, 2].min())
    return WideLens(params, camera_family(camera), (camera.width, camera.height), least, tuple(views))


def _shown_rays(camera: Camera) -> FloatArray:
    """Return unit vectors (N, 3) of a grid of pixels, without pixels that no ray reaches."""
    grid = 257  # rows and columns of pixels; chosen by hand
    x, y = np.meshgrid(np.linspace(0.0, camera.width, grid), np.linspace(0.0, camera.height, grid))
    pixels = np.column_stack([x.ravel(), y.ravel()])
    rays, family = np.array(camera.cam_ray_from_img(pixels), np.float64), camera_family(camera)
    with np.errstate(invalid="ignore"):
        projected = image_points(rays, read_camera(camera), family)
        # if a pixel is far from the projection of its ray, the lens shows nothing or folds (limit chosen by hand);
        # the seam of a panorama is at both of its borders
        sound = (family == PANORAMA) | (np.linalg.norm(projected - pixels, axis=1) < 0.5)
        sound &= np.isfinite(rays).all(axis=1)
        if family == FISHEYE:
            sound &= rays[:, 2] >= np.cos(SEEN_ANGLE)
    return np.asarray(rays[sound], np.float64)


def _add_view_cameras(view_model: Reconstruction, lenses: Mapping[int, WideLens]) -> dict[tuple[int, int], int]:
    """Add a camera for every view, and return its id by the camera of the photo and the number of the view."""
    ids = dict[tuple[int, int], int]()
    for camera_id, lens in sorted(lenses.items()):
        for number, view in enumerate(lens.views):
            ids[camera_id, number] = len(ids) + 1
            K = view.K
            camera = Camera(
                camera_id=len(ids), model="PINHOLE", width=view.width, height=view.height,
                params=[K[0, 0], K[1, 1], K[0, 2], K[1, 2]],
            )  # fmt: skip
            view_model.add_camera_with_trivial_rig(camera)
    return ids
