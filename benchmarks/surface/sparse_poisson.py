"""COLMAP's surface without CUDA: Poisson reconstruction from the sparse points of the same run."""

import tempfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import trimesh
from numpy.typing import NDArray

from sfm_app.colmap.backend import pycolmap
from sfm_app.meshing.ray_casting import load_open3d
from sfm_app.types import Surface

FloatArray = NDArray[np.float64]
NEIGHBORS = 16
"""Number of points that a normal is fitted to."""
DEPTH = 10
"""Depth of the octree; with so few points, COLMAP's 13 gives the same surface but takes longer."""
TRIMS = (7.0, 6.0, 5.0, 4.0)
"""Trimmings to try; COLMAP's default, 10, removes the whole surface of points as few as these."""
_VERTEX = np.dtype(
    [*((name, "<f4") for name in ("x", "y", "z", "nx", "ny", "nz")), *((c, "u1") for c in ("r", "g", "b"))]
)


def sparse_surfaces(model_dir: Path) -> Iterator[tuple[float, Surface]]:
    """Yield surfaces under several trimmings: more trimming leaves less surface where there are no points."""
    points, normals, colors = oriented_points(pycolmap.Reconstruction(model_dir))
    with tempfile.TemporaryDirectory(prefix="rival-") as scratch:
        source, target = Path(scratch) / "points.ply", Path(scratch) / "mesh.ply"
        source.write_bytes(points_ply(points, normals, colors))
        for trim in TRIMS:
            options = pycolmap.PoissonMeshingOptions()
            options.depth, options.trim, options.num_threads = DEPTH, trim, 1
            pycolmap.poisson_meshing(source, target, options=options)
            mesh = trimesh.load(target, process=False)
            faces = np.asarray(getattr(mesh, "faces", ()), np.int64).reshape(-1, 3)
            vertices = np.asarray(mesh.vertices, np.float64).reshape(-1, 3)
            yield trim, Surface(vertices, faces, np.zeros((len(vertices), 3), np.uint8))


def oriented_points(model: "pycolmap.Reconstruction") -> tuple[FloatArray, FloatArray, NDArray[np.uint8]]:
    """Return points (N, 3), unit normals (N, 3) that face the photos that see them, and colors (N, 3)."""
    centers = {key: image.projection_center() for key, image in model.images.items() if image.has_pose}
    known = [model.points3D[key] for key in sorted(model.points3D)]
    points = np.array([point.xyz for point in known]).reshape(-1, 3)
    seen_from = np.array([np.mean([centers[e.image_id] for e in point.track.elements], axis=0) for point in known])
    open3d = load_open3d()
    cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points))
    cloud.estimate_normals(open3d.geometry.KDTreeSearchParamKNN(NEIGHBORS))
    normals = np.asarray(cloud.normals).copy()
    normals[((seen_from - points) * normals).sum(axis=1) < 0] *= -1.0
    return points, normals, np.array([point.color for point in known], np.uint8).reshape(-1, 3)


def points_ply(points: FloatArray, normals: FloatArray, colors: NDArray[np.uint8]) -> bytes:
    """Encode the points as COLMAP writes fused.ply."""
    rows = np.empty(len(points), _VERTEX)
    for names, values in (("xyz", points), (("nx", "ny", "nz"), normals), ("rgb", colors)):
        for k, name in enumerate(names):
            rows[name] = values[:, k]
    properties = [f"property float {name}" for name in ("x", "y", "z", "nx", "ny", "nz")]
    properties += [f"property uchar {name}" for name in ("red", "green", "blue")]
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(points)}", *properties, "end_header", ""]
    return "\n".join(header).encode("ascii") + rows.tobytes()
