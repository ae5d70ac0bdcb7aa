"""Triangles in space."""

import numpy as np
from numpy.typing import NDArray

from sfm_app.types import Surface

FloatArray = NDArray[np.float64]
IndexArray = NDArray[np.int64]


def vertex_normals(vertices: FloatArray, faces: IndexArray) -> FloatArray:
    """Return (V, 3) unit normals, means over the triangles at each vertex weighted by area; 0 at unused vertices.

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


def unit_normals(surface: Surface) -> FloatArray:
    """Return (V, 3) unit normals; (0, 1, 0) where triangles without area do not define one.

    glTF requires unit normals.
    """
    normals = vertex_normals(surface.vertices, surface.faces)
    normals[np.linalg.norm(normals, axis=1) < 0.5] = (0.0, 1.0, 0.0)
    return normals


def unique_edges(faces: IndexArray) -> tuple[IndexArray, IndexArray]:
    """Return every edge once, (E, 2) with the lower vertex first, and (T, 3) their numbers per triangle: ab, bc, ca."""
    ends = np.sort(np.stack([faces, np.roll(faces, -1, axis=1)], axis=2).reshape(-1, 2), axis=1)
    size = int(faces.max(initial=0)) + 1
    keys, at = np.unique(ends[:, 0] * size + ends[:, 1], return_inverse=True)
    return np.stack(np.divmod(keys, size), axis=1), at.reshape(-1, 3)


def areas(vertices: FloatArray, faces: IndexArray) -> FloatArray:
    """Return the areas (T,) of triangles.

    Args:
        vertices: (V, 3) points.
        faces: (T, 3) vertex indices.
    """
    corners = vertices[faces]
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return np.asarray(0.5 * np.linalg.norm(across, axis=1))


def median_edge_length(vertices: FloatArray, faces: IndexArray) -> float:
    """Return the median length of the edges.

    Args:
        vertices: (V, 3) points.
        faces: (T, 3) vertex indices.
    """
    edges, _ = unique_edges(faces)
    return float(np.median(np.linalg.norm(vertices[edges[:, 0]] - vertices[edges[:, 1]], axis=1)))


def select_faces(surface: Surface, keep: NDArray[np.bool_]) -> Surface:
    """Return the marked triangles with the vertices that they use, in the same order.

    Args:
        surface: T triangles and their vertices.
        keep: (T,) True for the triangles to keep.
    """
    used, faces = number_vertices(surface.faces[keep])
    return Surface(surface.vertices[used], faces.astype(np.int64), surface.colors[used])


def number_vertices(faces: NDArray[np.integer]) -> tuple[IndexArray, IndexArray]:
    """Return the vertices (N,) that triangles use, in order, and the triangles (T, 3) with indices among these.

    Args:
        faces: (T, 3) vertex indices.
    """
    used, at = np.unique(faces, return_inverse=True)
    return used, at.reshape(-1, 3)
