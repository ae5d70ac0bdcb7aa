"""COLMAP's dense workspace: undistorted photos, depth and normal maps, their fusion, Poisson's surface."""

from collections.abc import Sequence
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
import trimesh
from numpy.typing import NDArray

from sfm_app.colmap.backend import backend, pycolmap
from sfm_app.stereo import DepthMap, View
from sfm_app.types import Surface

FUSED = "fused.ply"
JPEG_QUALITY = 98
MAX_NORMAL_ERROR_DEG = 25.0
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


def fuse(dense_dir: Path, views: Sequence[View], min_views: int, box: NDArray[np.float64]) -> int:
    """Fuse the geometric maps of these views into `fused.ply`; gives the number of points.

    Args:
        dense_dir: dense workspace.
        views: those that have maps.
        min_views: photos that have to see a point.
        box: (2, 3) lowest and highest coordinates that are kept.
    """
    config = "".join(f"{view.name}\n" for view in views)
    (dense_dir / "stereo" / "fusion.cfg").write_text(config, encoding="utf-8")
    options = pycolmap.StereoFusionOptions()
    options.min_num_pixels = min_views
    # The depths have been checked already; normals from disparities are noisier than those of COLMAP's PatchMatch.
    options.max_normal_error = MAX_NORMAL_ERROR_DEG
    options.bounding_box = (box[0].astype(np.float32), box[1].astype(np.float32))
    options.num_threads = 1  # with more, the points depend on which thread comes first
    with backend("fusing depth maps"):
        fused = pycolmap.stereo_fusion(dense_dir / FUSED, dense_dir, options=options, output_type="ply")
    return int(fused.num_points3D())


def read_fused(dense_dir: Path) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Fused points (N, 3) and their unit normals (N, 3), which point to the photos that see them."""
    with backend("reading the fused points"):
        vertex = trimesh.load(dense_dir / FUSED).metadata["_ply_raw"]["vertex"]["data"]
        points, normals = (np.stack([vertex[c] for c in names], axis=1) for names in ("xyz", ("nx", "ny", "nz")))
    return points.astype(np.float64), normals.astype(np.float64)


def poisson(dense_dir: Path, depth: int, trim: float) -> Surface:
    """Poisson's surface (Kazhdan and Hoppe, ACM TOG 2013) through the fused points, with their colours.

    Args:
        dense_dir: dense workspace.
        depth: of the octree; the finest cell is the largest extent of the points over 2^depth.
        trim: surface in cells of a lower depth than this, where points are few, is left out; 0: none.
    """
    options = pycolmap.PoissonMeshingOptions()
    options.depth, options.trim = depth, trim
    options.num_threads = 1  # with more: other triangles in every run, and many times slower where cores are shared
    path = dense_dir / "poisson.ply"
    with backend("finding the surface"):
        pycolmap.poisson_meshing(dense_dir / FUSED, path, options=options)
        mesh = trimesh.load(path, process=False)
        path.unlink()
    return Surface(
        np.asarray(mesh.vertices, np.float64),
        np.asarray(mesh.faces, np.int64),
        np.asarray(mesh.visual.vertex_colors, np.uint8)[:, :3],
    )
