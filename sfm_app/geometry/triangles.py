"""Triangles in space."""

import numpy as np
from numpy.typing import NDArray

from sfm_app.jit import kernel
from sfm_app.types import Surface

FloatArray = NDArray[np.float64]
IndexArray = NDArray[np.int64]


def vertex_normals(vertices: FloatArray, faces: IndexArray) -> FloatArray:
    """Return (V, 3) unit normals, means over the triangles at each vertex weighted by area; 0 at unused vertices.

    Args:
        vertices: (V, 3).
        faces: (T, 3) vertex indices, counter-clockwise seen from outside.
    """
    total = np.zeros((len(vertices), 3))
    _add_normals(np.ascontiguousarray(vertices, np.float64), np.ascontiguousarray(faces, np.int64), total)
    length = np.linalg.norm(total, axis=1, keepdims=True)
    return np.asarray(np.divide(total, length, out=np.zeros_like(total), where=length > 0))


@kernel
def _add_normals(vertices: FloatArray, faces: IndexArray, total: FloatArray) -> None:
    """Add the cross product of two edges of every triangle at its corners."""
    for f in range(len(faces)):
        a, b, c = vertices[faces[f, 0]], vertices[faces[f, 1]], vertices[faces[f, 2]]
        bx, by, bz = b[0] - a[0], b[1] - a[1], b[2] - a[2]
        cx, cy, cz = c[0] - a[0], c[1] - a[1], c[2] - a[2]
        x, y, z = by * cz - bz * cy, bz * cx - bx * cz, bx * cy - by * cx
        for k in range(3):
            v = faces[f, k]
            total[v, 0] += x
            total[v, 1] += y
            total[v, 2] += z


def unit_normals(surface: Surface) -> FloatArray:
    """Return (V, 3) unit normals; (0, 1, 0) where triangles without area do not define one.

    glTF requires unit normals.
    """
    normals = vertex_normals(surface.vertices, surface.faces)
    normals[np.linalg.norm(normals, axis=1) < 0.5] = (0.0, 1.0, 0.0)
    return normals


def unique_edges(faces: IndexArray) -> tuple[IndexArray, IndexArray]:
    """Return every edge once, (E, 2) with the lower vertex first, and (T, 3) their numbers per triangle: ab, bc, ca."""
    size = int(faces.max(initial=-1)) + 1
    edges, edge_of = np.empty((faces.size, 2), np.int64), np.empty(faces.shape, np.int64)
    count = _number_edges(np.ascontiguousarray(faces, np.int64), size, edges, edge_of)
    return edges[:count].copy(), edge_of


@kernel
def _number_edges(faces: IndexArray, size: int, edges: IndexArray, edge_of: IndexArray) -> int:
    """Fill in every edge once, in order, and the number of each one per triangle; return how many there are.

    They are put in order by the higher vertex and then by the lower one, in as many buckets as there are vertices.
    """
    sides = 3 * len(faces)
    low, high = np.empty(sides, np.int64), np.empty(sides, np.int64)
    for f in range(len(faces)):
        for k in range(3):
            a, b = faces[f, k], faces[f, (k + 1) % 3]
            low[3 * f + k], high[3 * f + k] = min(a, b), max(a, b)
    by_high, order = np.empty(sides, np.int64), np.empty(sides, np.int64)
    _put_in_buckets(high, np.arange(sides), size, by_high)
    _put_in_buckets(low, by_high, size, order)
    count = 0
    for k in range(sides):
        side = order[k]
        if not count or edges[count - 1, 0] != low[side] or edges[count - 1, 1] != high[side]:
            edges[count, 0], edges[count, 1] = low[side], high[side]
            count += 1
        edge_of[side // 3, side % 3] = count - 1
    return count


@kernel
def _put_in_buckets(key: IndexArray, order: IndexArray, size: int, found: IndexArray) -> None:
    """Fill in the members of `order` by their key, below `size`; those of one key stay in order."""
    place = np.zeros(size + 1, np.int64)
    for k in range(len(order)):
        place[key[k] + 1] += 1
    for k in range(size):
        place[k + 1] += place[k]
    for member in order:
        found[place[key[member]]] = member
        place[key[member]] += 1


def bucket_order(keys: IndexArray, size: int) -> IndexArray:
    """Return the order (N,) that sorts keys, as a stable sort does, in time that grows with them and their range.

    Args:
        keys: (N,) in [0, size).
        size: number of different keys, about N or less.
    """
    found = np.empty(len(keys), np.int64)
    _put_in_buckets(np.ascontiguousarray(keys, np.int64), np.arange(len(keys)), size, found)
    return found


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
    is_used = np.zeros(int(faces.max(initial=-1)) + 1, np.bool_)
    is_used[faces] = True
    return np.flatnonzero(is_used), (np.cumsum(is_used) - 1)[faces].reshape(-1, 3)


def split_fans(surface: Surface) -> Surface:
    """Give every fan of triangles around a vertex its own copy of the vertex."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    count = len(surface.faces)
    edges, edge_of = unique_edges(surface.faces)
    # corners of two triangles belong together where the triangles share an edge that ends there
    order = bucket_order(edge_of.ravel(), len(edges))
    same = np.flatnonzero(np.diff(edge_of.ravel()[order]) == 0)
    face_a, side_a = np.divmod(order[same], 3)
    face_b, side_b = np.divmod(order[same + 1], 3)
    joined = [
        (3 * face_a + side_a, 3 * face_b + (side_b + 1) % 3),
        (3 * face_a + (side_a + 1) % 3, 3 * face_b + side_b),
    ]
    rows, cols = np.concatenate(joined, axis=1)
    graph = coo_array((np.ones(len(rows), bool), (rows, cols)), (3 * count, 3 * count))
    fans, fan = connected_components(graph, directed=False)
    vertex = np.empty(fans, np.int64)
    vertex[fan] = surface.faces.ravel()
    order = bucket_order(vertex, len(surface.vertices))
    rank = np.empty(len(order), np.int64)
    rank[order] = np.arange(len(order))
    vertex = vertex[order]
    return Surface(surface.vertices[vertex], rank[fan].reshape(-1, 3), surface.colors[vertex])
