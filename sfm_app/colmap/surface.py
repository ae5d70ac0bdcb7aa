"""COLMAP's fusion of depth maps, and Poisson's surface through the fused points."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import trimesh
from numpy.typing import NDArray

from sfm_app.colmap.backend import backend, pycolmap
from sfm_app.stereo import View
from sfm_app.types import Surface

FUSED = "fused.ply"
MAX_NORMAL_ERROR_DEG = 25.0


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
