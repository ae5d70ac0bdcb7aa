"""COLMAP's dense workspace: undistorted photos, their masks, depth maps and normal maps."""

import secrets
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from math import ceil
from pathlib import Path

import cv2
import numpy as np

from sfm_app.colmap import tasks
from sfm_app.colmap.backend import Camera, Reconstruction, check_written, pycolmap, translate_errors
from sfm_app.colmap.model import all_images
from sfm_app.colmap.worker_process import run_worker
from sfm_app.files import digest_files, is_below
from sfm_app.operating_system import replace_file
from sfm_app.photos.masks import mask_path, read_mask, save_mask
from sfm_app.progress import Progress
from sfm_app.settings import MOST_LEVELS
from sfm_app.stereo import DepthEstimate, DepthMap, Kind, View
from sfm_app.tasks import Shared
from sfm_app.types.arrays import BoolArray, ByteArray, Float32Array

MASKS = "masks"
DEPTHS, NORMALS, CONFIDENCES = "depth_maps", "normal_maps", "confidence_maps"
MASKED = -1.0
"""Depth of a masked pixel. COLMAP's fusion reads it as no depth; `sfm_app.meshing` does not read it as empty space."""
MAPS = ("sparse", "images", f"stereo/{DEPTHS}", f"stereo/{NORMALS}")
"""Folders from which a finished workspace is read."""


def cameras_of_photos(model_dir: Path) -> dict[str, Camera]:
    """Return the camera of each photo of a model, by name."""
    with translate_errors("reading the model"):
        model = Reconstruction(model_dir)
        return {image.name: model.cameras[image.camera_id] for image in all_images(model)}


def undistort_mask(cameras: Shared[Mapping[str, Camera]], mask_dir: Path, dense_dir: Path, view: View) -> None:
    """Write the mask of an undistorted photo: a pixel is used if all original pixels under it are."""
    used, camera = read_mask(mask_dir, view.name), cameras.value[view.name]
    x, y = np.meshgrid(np.arange(view.width) + 0.5, np.arange(view.height) + 0.5)
    rays = view.rays(np.column_stack([x.ravel(), y.ravel()]))
    with translate_errors(f"undistorting the mask of {view.name}"):
        pixels = np.floor(np.asarray(camera.img_from_cam(rays))).astype(np.int64).reshape(view.height, view.width, 2)
    col, row = pixels[..., 0], pixels[..., 1]
    height, width = used.shape
    inside = (col >= 0) & (col < width) & (row >= 0) & (row < height)
    whole = _erode(used, ceil(max(camera.focal_length_x / view.K[0, 0], camera.focal_length_y / view.K[1, 1])))
    shown = shrink_mask(inside & whole[row.clip(0, height - 1), col.clip(0, width - 1)])
    save_mask(dense_dir / MASKS, view.name, shown)


def used_pixels(dense_dir: Path, view: View) -> BoolArray | None:
    """Return the mask (H, W) of an undistorted photo, true where pixels may be used; None without mask."""
    place = dense_dir / MASKS
    return read_mask(place, view.name) if mask_path(place, view.name).exists() else None


def shrink_mask(used: BoolArray) -> BoolArray:
    """Return the mask (H, W) of an undistorted photo without the two pixels beside masked ones."""
    return _erode(used, 2)


def _erode(used: BoolArray, reach: int) -> BoolArray:
    square = np.ones((2 * reach + 1, 2 * reach + 1), np.uint8)
    return np.asarray(cv2.erode(used.view(np.uint8), square)) > 0


def undistort(
    model_dir: Path, photo_dir: Path, dense_dir: Path, max_side_px: int, workers: int, progress: Progress
) -> None:
    """Write undistorted photos and the matching model into a dense workspace; larger photos are scaled down."""
    (dense_dir / "images").mkdir(parents=True, exist_ok=True)
    call = partial(tasks.undistort, dense_dir, model_dir, photo_dir, max_side_px, workers)
    run_worker(call, "undistorting photos", progress)


def read_views(dense_dir: Path) -> list[View]:
    """Return the undistorted views with the sparse points that they observe, by name."""
    with translate_errors("reading the undistorted model"):
        model = Reconstruction(dense_dir / "sparse")
        images = sorted(all_images(model), key=lambda image: image.name)
        if not all(is_below(image.name) for image in images):
            raise ValueError(f"the model in {dense_dir} names photos outside of it")
        return [_view(model, image) for image in images if image.has_pose]


def _view(model: Reconstruction, image: pycolmap.Image) -> View:
    camera = model.cameras[image.camera_id]
    ids = sorted({point.point3D_id for point in image.points2D if point.has_point3D()})
    return View(
        name=image.name,
        K=np.array(camera.calibration_matrix(), np.float64),
        cam_from_world=np.array(image.cam_from_world().matrix(), np.float64),
        width=camera.width,
        height=camera.height,
        point_ids=np.array(ids, np.int64),
        points=np.array([model.points3D[i].xyz for i in ids], np.float64).reshape(-1, 3),
        # COLMAP's fusion puts the depth of pixel (row, col) on the ray through (col, row), half a pixel off its center.
        sample_px=0.0,
    )


def read_gray(dense_dir: Path, view: View) -> ByteArray:
    """Return the undistorted photo (H, W) of a view."""
    return np.asarray(_decode(dense_dir, view.name, cv2.IMREAD_GRAYSCALE), np.uint8)


def _decode(dense_dir: Path, name: str, flags: int) -> ByteArray | None:
    # imdecode, because OpenCV does not open names beyond ASCII on every system
    image = cv2.imdecode(np.fromfile(dense_dir / "images" / name, np.uint8), flags)
    return None if image is None else np.asarray(image, np.uint8)


def map_file(dense_dir: Path, view: View) -> Path:
    """Return the path of the confirmed depths of a view, whether or not it exists."""
    return _map_path(dense_dir, DEPTHS, view, "geometric")


def normals_file(dense_dir: Path, view: View) -> Path:
    """Return the path of the normals of a view, whether or not it exists."""
    return _map_path(dense_dir, NORMALS, view, "geometric")


class DenseStore:
    """Photos and maps of a dense workspace; implements `sfm_app.stereo.DepthStore`."""

    def __init__(self, dense_dir: Path) -> None:
        self.dense_dir = dense_dir

    def photo(self, view: View) -> ByteArray:
        """Return the undistorted photo (H, W) at the size of the view."""
        photo = read_gray(self.dense_dir, view)
        return _resize(photo, view) if view.level else photo

    def has(self, view: View, kind: Kind) -> bool:
        """Return whether a depth map exists."""
        # the depth map is written last
        return _map_path(self.dense_dir, DEPTHS, view, kind).is_file()

    def read_estimate(self, view: View) -> DepthEstimate:
        """Read the photometric map of a view."""
        confidences = _map_path(self.dense_dir, CONFIDENCES, view, "photometric")
        return DepthEstimate(self.read_depth(view), _read_depth_format(confidences, view.name))

    def read_depth(self, view: View, kind: Kind = "photometric") -> Float32Array:
        """Read the depths of a map of a view."""
        return read_depth(self.dense_dir, view, kind)

    def read_maps(self, view: View) -> DepthMap:
        """Read the geometric maps of a view."""
        with translate_errors(f"reading the normal map of {view.name}"):
            stored = pycolmap.NormalMap()
            stored.read(normals_file(self.dense_dir, view))
        planes = np.array(stored.to_array(), np.float32)
        height, width = planes.shape[:2]
        normals = np.ascontiguousarray(planes.reshape(3, height, width).transpose(1, 2, 0))
        return DepthMap(self.read_depth(view, "geometric"), normals)

    def write_depth(self, view: View, depth: Float32Array, kind: Kind) -> None:
        """Write depths (H, W) of a view, 0 where unknown, without normals."""
        _write_depth_format(self.dense_dir, DEPTHS, view, depth, kind)

    def write_estimate(self, view: View, estimate: DepthEstimate) -> None:
        """Write the photometric map of a view, without depth where the photo is masked."""
        used = used_pixels(self.dense_dir, view)
        if used is not None:
            if view.level:  # a pixel is used if all pixels under it are
                used = _resize(used.view(np.uint8) * np.uint8(255), view) == 255
            # full confidence, so that masked pixels do not become part of a blank area beside them
            estimate = DepthEstimate(estimate.depth * used, np.where(used, estimate.confidence, np.float32(1)))
        _write_depth_format(self.dense_dir, CONFIDENCES, view, estimate.confidence, "photometric")
        _write_depth_format(self.dense_dir, DEPTHS, view, estimate.depth, "photometric")

    def write_maps(self, view: View, maps: DepthMap, kind: Kind = "geometric") -> None:
        """Write the confirmed depths (H, W) and the normals (H, W, 3) of a view, as COLMAP's fusion expects them."""
        # pycolmap takes (H, W, 3) but stores the bytes unchanged, while COLMAP keeps x, y and z in planes.
        planes = np.ascontiguousarray(maps.normals.transpose(2, 0, 1)).reshape(maps.normals.shape)
        with (
            translate_errors(f"writing the normal map of {view.name}"),
            _atomic_path(_map_path(self.dense_dir, NORMALS, view, kind)) as path,
        ):
            pycolmap.NormalMap.from_array(planes).write(path)
        _write_depth_format(self.dense_dir, DEPTHS, view, maps.depth, kind)


def names_of_estimates(dense_dir: Path) -> list[str]:
    """Return the names of the views that have a photometric map of full size, the oldest first."""
    folder, ending = dense_dir / "stereo" / DEPTHS, ".photometric.bin"
    files = sorted((path.stat().st_mtime_ns, path) for path in folder.rglob(f"*{ending}"))
    return [path.relative_to(folder).as_posix().removesuffix(ending) for _, path in files]


def read_depth(dense_dir: Path, view: View, kind: Kind) -> Float32Array:
    """Read a depth map (H, W): 0 where unknown, MASKED where the photo is masked, SKY where it shows the sky."""
    return _read_depth_format(_map_path(dense_dir, DEPTHS, view, kind), view.name)


def write_depth(dense_dir: Path, view: View, depth: Float32Array) -> None:
    """Write the confirmed depths (H, W) of a view, 0 where unknown."""
    _write_depth_format(dense_dir, DEPTHS, view, depth, "geometric")


def mask_depths(dense_dir: Path, view: View, depth: Float32Array) -> Float32Array:
    """Return the depths (H, W) of a view with MASKED where the photo is masked."""
    used = used_pixels(dense_dir, view)
    return depth if used is None else np.where(used, depth, np.float32(MASKED))


def publish_maps(dense_dir: Path, view: View) -> None:
    """Replace the geometric maps of a view by the final ones, unless a killed run has."""
    for folder in (NORMALS, DEPTHS):
        if (final := _map_path(dense_dir, folder, view, "final")).exists():
            replace_file(final, _map_path(dense_dir, folder, view, "geometric"))


def drop_estimates(dense_dir: Path, views: Sequence[View]) -> None:
    """Remove the photometric and closed maps of all views."""
    for view in views:
        _map_path(dense_dir, DEPTHS, view, "closed").unlink(missing_ok=True)
        for scaled in (view, *(view.halve(level) for level in range(1, MOST_LEVELS))):
            for folder in (DEPTHS, NORMALS, CONFIDENCES):
                _map_path(dense_dir, folder, scaled, "photometric").unlink(missing_ok=True)


def write_fusion_views(dense_dir: Path, views: Sequence[View]) -> None:
    """Write the list of views that have maps, for COLMAP's fusion."""
    config = "".join(f"{view.name}\n" for view in views if map_file(dense_dir, view).exists())
    (dense_dir / "stereo" / "fusion.cfg").write_text(config, encoding="utf-8", newline="\n")


def digest_maps(dense_dir: Path) -> str:
    """Return the hash of the files from which a finished workspace is read."""
    return digest_files(dense_dir, *MAPS)


def _read_depth_format(path: Path, photo: str) -> Float32Array:
    with translate_errors(f"reading the depth map of {photo}"):
        stored = pycolmap.DepthMap()
        stored.read(path)
    return np.array(stored.to_array(), np.float32)


def _write_depth_format(dense_dir: Path, folder: str, view: View, values: Float32Array, kind: Kind) -> None:
    known = values[values > 0]
    low, high = (float(known.min()), float(known.max())) if known.size else (0.0, 0.0)
    with (
        translate_errors(f"writing the depth map of {view.name}"),
        _atomic_path(_map_path(dense_dir, folder, view, kind)) as path,
    ):
        pycolmap.DepthMap.from_array(np.ascontiguousarray(values), low, high).write(path)


def _map_path(dense_dir: Path, folder: str, view: View, kind: Kind) -> Path:
    return dense_dir / "stereo" / folder / f"{view.name}.{kind}{view.level or ''}.bin"


def _resize(picture: ByteArray, view: View) -> ByteArray:
    return np.asarray(cv2.resize(picture, (view.width, view.height), interpolation=cv2.INTER_AREA), np.uint8)


@contextmanager
def _atomic_path(target: Path) -> Iterator[Path]:
    """Provide a temporary path beside `target`, and rename it to `target` once everything is written."""
    target.parent.mkdir(parents=True, exist_ok=True)
    beside = target.with_name(f".{secrets.token_hex(4)}.{target.name}")  # two machines may write the same map
    yield beside
    check_written(beside)
    replace_file(beside, target)


def read_photo_and_depth(dense_dir: Path, name: str, kind: Kind = "geometric") -> tuple[ByteArray, Float32Array]:
    """Return the undistorted photo (H, W, 3) RGB and its depths (H, W), <= 0 where there is none.

    Raises:
        ValueError: the name leads out of the workspace, or the file is no photo.
        OSError: the photo does not exist.
        BackendError: the depth map cannot be read.
    """
    if not is_below(name):
        raise ValueError(f"{name} is not in {dense_dir}")
    image = _decode(dense_dir, name, cv2.IMREAD_COLOR_RGB)
    if image is None:
        raise ValueError(f"{name} is no photo")
    return image, _read_depth_format(dense_dir / "stereo" / DEPTHS / f"{name}.{kind}.bin", name)
