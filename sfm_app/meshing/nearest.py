"""Normals of a fine surface at the places that are closest to points."""

import numpy as np
from numpy.typing import NDArray

from sfm_app.geometry.triangles import median_edge_length, vertex_normals
from sfm_app.meshing.open3d import load_open3d

REACH_EDGES = 4.0
"""Distance from the fine surface, in median edges of it, beyond which it says nothing about a point. Chosen on
fountain-P11 with 50 000 triangles (benchmarks/surface/normal_map.py): 1 leaves out 0.4 % of the texels, 16 none that 4
leaves out; the angles are the same."""


class NearestNormals:
    """A fine surface, prepared to be asked for its normals near points; several threads may ask at once."""

    def __init__(self, vertices: NDArray[np.float32], faces: NDArray[np.int32]) -> None:
        """Prepare the search.

        Args:
            vertices: (V, 3).
            faces: (T, 3) vertex indices.
        """
        self._faces, self._scene = faces, None
        if not len(faces):
            return
        places = vertices.astype(np.float64)
        self._normals = vertex_normals(places, faces.astype(np.int64)).astype(np.float32)
        self._reach = REACH_EDGES * median_edge_length(places, faces.astype(np.int64))
        self._tensor = load_open3d().core.Tensor
        self._scene = load_open3d().t.geometry.RaycastingScene(nthreads=1)
        self._scene.add_triangles(self._tensor(vertices), self._tensor(faces.astype(np.uint32)))
        self.find(vertices[:1], self._normals[:1])  # builds the tree, which only one thread may

    def find(self, points: NDArray[np.float32], facing: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return (N, 3) unit normals, interpolated at the closest place; 0 where it is far away or faces elsewhere.

        Args:
            points: (N, 3).
            facing: (N, 3) directions, from which a normal may differ by less than a right angle.
        """
        if self._scene is None or not len(points):
            return np.zeros_like(points)
        found = self._scene.compute_closest_points(self._tensor(np.ascontiguousarray(points)), nthreads=1)
        second = found["primitive_uvs"].numpy()
        shares = np.concatenate([1.0 - second.sum(axis=1, keepdims=True), second], axis=1)
        corners = self._normals[self._faces[found["primitive_ids"].numpy().astype(np.int64)]]
        normals = (shares[:, :, None] * corners).sum(axis=1)
        length = np.linalg.norm(normals, axis=1)
        good = np.linalg.norm(found["points"].numpy() - points, axis=1) <= self._reach
        good &= ((normals * facing).sum(axis=1) > 0) & (length > 0)
        return np.where(good[:, None], normals / np.where(good, length, 1.0)[:, None], 0).astype(np.float32)
