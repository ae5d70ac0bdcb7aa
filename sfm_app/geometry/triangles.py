"""Triangles in space."""

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
IndexArray = NDArray[np.int64]


def vertex_normals(vertices: FloatArray, faces: IndexArray) -> FloatArray:
    """(V, 3) unit normals, each the mean over the triangles at the vertex by their area; 0 where there are none.

    Args:
        vertices: (V, 3).
        faces: (T, 3) vertex indices, counter-clockwise seen from outside.
    """
    corners = vertices[faces]
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    at, size = faces.ravel(), len(vertices)
    total = np.stack([np.bincount(at, np.repeat(across[:, i], 3), size) for i in range(3)], axis=1)
    length = np.linalg.norm(total, axis=1, keepdims=True)
    return np.asarray(np.divide(total, length, out=np.zeros_like(total), where=length > 0))
