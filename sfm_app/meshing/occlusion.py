"""Occlusion of points on a surface by the surface."""

import numpy as np
from numpy.typing import NDArray

from sfm_app.meshing.open3d import load_open3d


class Occluders:
    """Triangles that may hide points from cameras."""

    def __init__(self, vertices: NDArray[np.float64], faces: NDArray[np.int64]) -> None:
        """Prepare for ray casting.

        Args:
            vertices: (V, 3).
            faces: (T, 3) vertex indices.
        """
        self._tensor = load_open3d().core.Tensor
        self._scene = load_open3d().t.geometry.RaycastingScene(nthreads=1)
        self._scene.add_triangles(self._tensor(vertices.astype(np.float32)), self._tensor(faces.astype(np.uint32)))

    def is_hidden(self, center: NDArray[np.float64], slack: float, points: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Return (N,) whether a triangle lies between a point and the camera.

        Args:
            center: (3,) of the camera.
            slack: length of the start of each ray that is ignored, because the point's own triangles are there.
            points: (N, 3).
        """
        way = center - points
        length = np.linalg.norm(way, axis=1, keepdims=True)
        start = points + way * np.minimum(slack / np.maximum(length, 1e-300), 1.0)
        rays = np.concatenate([start, center - start], axis=1).astype(np.float32)
        found = self._scene.test_occlusions(self._tensor(rays), 0.0, 1.0, nthreads=1)
        return np.asarray(found.numpy(), np.bool_)
