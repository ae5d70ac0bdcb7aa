"""COLMAP's dense workspace: undistorted photos, depth and normal maps."""

from pathlib import Path
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from sfm_app.colmap.backend import backend, pycolmap
from sfm_app.stereo import DepthMap, View

JPEG_QUALITY = 98
Kind = Literal["photometric", "geometric"]
"""COLMAP's names for a depth map before and after the check against the other photos."""


def undistort(model_dir: Path, photo_dir: Path, dense_dir: Path, max_side_px: int) -> None:
    """Write photos without distortion and the model that fits them into a dense workspace.

    Raises:
        BackendError: COLMAP cannot read the model or the photos.
    """
    options = pycolmap.UndistortCameraOptions()
    options.max_image_size = max_side_px
    dense_dir.mkdir(parents=True, exist_ok=True)
    with backend("undistorting photos"):
        pycolmap.undistort_images(dense_dir, model_dir, photo_dir, undistort_options=options, jpeg_quality=JPEG_QUALITY)


def read_views(dense_dir: Path) -> list[View]:
    """The undistorted views with the sparse points that they observe, by name."""
    with backend("reading the undistorted model"):
        model = pycolmap.Reconstruction(dense_dir / "sparse")
        images = sorted(model.images.values(), key=lambda image: image.name)
        return [_view(model, image) for image in images if image.has_pose]


def _view(model: "pycolmap.Reconstruction", image: "pycolmap.Image") -> View:
    camera = model.cameras[image.camera_id]
    ids = sorted({point.point3D_id for point in image.points2D if point.has_point3D()})
    pose = image.cam_from_world().matrix()
    return View(
        name=image.name,
        K=np.array(camera.calibration_matrix(), np.float64),
        R=np.array(pose[:, :3], np.float64),
        t=np.array(pose[:, 3], np.float64),
        width=camera.width,
        height=camera.height,
        point_ids=np.array(ids, np.int64),
        points=np.array([model.points3D[i].xyz for i in ids], np.float64).reshape(-1, 3),
        # COLMAP's fusion puts the depth of pixel (row, col) on the ray through (col, row), half a pixel off its centre.
        sample_px=0.0,
    )


def read_grey(dense_dir: Path, view: View) -> NDArray[np.uint8]:
    """The undistorted photo of a view, (H, W)."""
    # imdecode, because OpenCV does not open names beyond ASCII on every system
    image = cv2.imdecode(np.fromfile(dense_dir / "images" / view.name, np.uint8), cv2.IMREAD_GRAYSCALE)
    return np.asarray(image, np.uint8)


def read_color(dense_dir: Path, view: View) -> NDArray[np.uint8]:
    """The undistorted photo of a view, (H, W, 3) RGB."""
    image = cv2.imdecode(np.fromfile(dense_dir / "images" / view.name, np.uint8), cv2.IMREAD_COLOR_RGB)
    return np.asarray(image, np.uint8)


def map_file(dense_dir: Path, view: View) -> Path:
    """Where the confirmed depths of a view lie, if it has any."""
    return _map_path(dense_dir, "depth_maps", view, "geometric")


def write_depth(dense_dir: Path, view: View, depth: NDArray[np.float32], kind: Kind) -> None:
    """Write a depth map, (H, W), 0 where unknown."""
    known = depth[depth > 0]
    low, high = (float(known.min()), float(known.max())) if known.size else (0.0, 0.0)
    path = _map_path(dense_dir, "depth_maps", view, kind)
    with backend(f"writing the depth map of {view.name}"):
        pycolmap.DepthMap.from_array(np.ascontiguousarray(depth), low, high).write(path)


def read_depth(dense_dir: Path, view: View, kind: Kind) -> NDArray[np.float32]:
    """Read a depth map, (H, W), 0 where unknown."""
    with backend(f"reading the depth map of {view.name}"):
        stored = pycolmap.DepthMap()
        stored.read(_map_path(dense_dir, "depth_maps", view, kind))
    return np.array(stored.to_array(), np.float32)


def write_maps(dense_dir: Path, view: View, maps: DepthMap) -> None:
    """Write the confirmed depths and the normals of a view, as COLMAP's fusion expects them."""
    write_depth(dense_dir, view, maps.depth, "geometric")
    with backend(f"writing the normal map of {view.name}"):
        # pycolmap takes (H, W, 3) but stores the bytes as they come, where COLMAP keeps x, y and z in planes.
        planes = np.ascontiguousarray(maps.normals.transpose(2, 0, 1)).reshape(maps.normals.shape)
        pycolmap.NormalMap.from_array(planes).write(_map_path(dense_dir, "normal_maps", view, "geometric"))


def _map_path(dense_dir: Path, folder: str, view: View, kind: Kind) -> Path:
    path = dense_dir / "stereo" / folder / f"{view.name}.{kind}.bin"
    path.parent.mkdir(parents=True, exist_ok=True)
    return path
