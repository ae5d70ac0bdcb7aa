"""Triangles in space: normals, edges, areas, tangents, and culling by clusters of neighbors."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sfm_app.geometry.poses import normalize
from sfm_app.jit import kernel
from sfm_app.types import Surface
from sfm_app.types.arrays import BoolArray, Float32Array, FloatArray, IndexArray


def vertex_normals(vertices: FloatArray, faces: IndexArray) -> FloatArray:
    """Return (V, 3) unit normals: means over adjacent triangles weighted by area; 0 at unused vertices."""
    total = np.zeros((len(vertices), 3))
    _add_normals(np.ascontiguousarray(vertices, np.float64), np.ascontiguousarray(faces, np.int64), total)
    return normalize(total)


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
    """Return (V, 3) unit normals, as glTF requires; (0, 1, 0) where triangles without area do not define one."""
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
    """Fill in every edge once, by the higher vertex, then the lower, and their numbers; return how many there are."""
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
def _put_in_buckets(key: IndexArray, order: IndexArray, size: int, placed: IndexArray) -> None:
    """Fill in the members of `order` by their key, below `size`; those of one key stay in order."""
    place = np.zeros(size + 1, np.int64)
    for k in range(len(order)):
        place[key[k] + 1] += 1
    for k in range(size):
        place[k + 1] += place[k]
    for member in order:
        placed[place[key[member]]] = member
        place[key[member]] += 1


def bucket_order(keys: IndexArray, size: int) -> IndexArray:
    """Return the order (N,) that sorts keys in [0, size), as a stable sort does, in time linear in N and size."""
    order = np.empty(len(keys), np.int64)
    _put_in_buckets(np.ascontiguousarray(keys, np.int64), np.arange(len(keys)), size, order)
    return order


def areas(vertices: FloatArray, faces: IndexArray) -> FloatArray:
    """Return the areas (T,) of triangles."""
    corners = vertices[faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return np.asarray(0.5 * np.linalg.norm(normals, axis=1))


def median_edge_length(vertices: FloatArray, faces: IndexArray) -> float:
    """Return the median length of the edges."""
    edges, _ = unique_edges(faces)
    return float(np.median(np.linalg.norm(vertices[edges[:, 0]] - vertices[edges[:, 1]], axis=1)))


def select_faces(surface: Surface, keep: BoolArray) -> Surface:
    """Return the triangles with True in `keep` (T,), and the vertices that they use, in the same order."""
    used, faces = number_vertices(surface.faces[keep])
    return Surface(surface.vertices[used], faces.astype(np.int64), surface.colors[used])


def number_vertices(faces: NDArray[np.integer]) -> tuple[IndexArray, IndexArray]:
    """Return the vertices (N,) that triangles use, in order, and the triangles (T, 3) with indices among these."""
    is_used = np.zeros(int(faces.max(initial=-1)) + 1, np.bool_)
    is_used[faces] = True
    return np.flatnonzero(is_used), (np.cumsum(is_used) - 1)[faces].reshape(-1, 3)


def split_fans(surface: Surface) -> Surface:
    """Give every fan of triangles around a vertex its own copy of the vertex."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    count = len(surface.faces)
    edges, edge_of = unique_edges(surface.faces)
    # corners of two triangles belong together where their common edge ends there
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


# Tangent frames along a texture, in which a normal map is stored (glTF 2.0).


def corner_tangents(
    vertices: FloatArray, normals: FloatArray, faces: IndexArray, uv: Float32Array, page: NDArray[np.int32]
) -> Float32Array:
    """Return tangents (T, 3, 4) of the corners of triangles: a unit vector, and the handedness, 1 or -1.

    The tangent points right in the texture; the bitangent, handedness times the cross product of normal and tangent,
    points up. A tangent is the mean over the triangles that share a vertex, its place on the page and the handedness,
    weighted by their angles there, at a right angle to the unit normals (V, 3). `uv` (T, 3, 2) are the places of the
    corners on their pages (T,), from the top left.
    """
    corners = vertices[faces]
    tangents, handed = _face_tangents(corners, uv.astype(np.float64))
    weighted = corner_angles(corners)[:, :, None] * tangents[:, None, :]
    group = _shared_corners(faces, uv, page, handed)
    size = int(group.max(initial=-1)) + 1
    total = np.stack([np.bincount(group, column, size) for column in weighted.reshape(-1, 3).T], axis=1)
    straight = _straighten(np.asarray(total[group], np.float64), normals[faces].reshape(-1, 3)).reshape(-1, 3, 3)
    return np.concatenate([straight, np.repeat(handed, 3).reshape(-1, 3, 1)], axis=2).astype(np.float32)


def corner_angles(corners: FloatArray) -> FloatArray:
    """Return (T, 3) the angles of triangles in radians from their corners (T, 3, 3)."""
    sides = normalize(np.roll(corners, -1, axis=1) - corners)
    cosine = -(sides * np.roll(sides, 1, axis=1)).sum(axis=2)
    return np.asarray(np.arccos(np.clip(cosine, -1.0, 1.0)))


def _face_tangents(corners: FloatArray, places: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return (T, 3) where the texture goes right on each triangle, as a unit vector, and (T,) the handedness."""
    b, c = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    (ub, vb), (uc, vc) = (places[:, 1] - places[:, 0]).T, (places[:, 2] - places[:, 0]).T
    area = ub * vc - uc * vb
    # v grows downward: triangles counter-clockwise from outside have a negative area unless mirrored
    handed = np.where(area > 0, -1.0, 1.0)
    return normalize(np.sign(area)[:, None] * (vc[:, None] * b - vb[:, None] * c)), handed


def _shared_corners(faces: IndexArray, uv: Float32Array, page: NDArray[np.int32], handed: FloatArray) -> IndexArray:
    """Return (3 T,) for each corner the number of the group that has vertex, place, page and handedness in common."""
    place = uv.reshape(-1, 2)
    keys = (place[:, 1], place[:, 0], np.repeat(handed, 3), np.repeat(page, 3), faces.ravel())
    order = np.lexsort(keys)
    first = np.zeros(len(order), bool)
    for key in keys:
        first[1:] |= np.diff(key[order]) != 0
    groups = np.empty(len(order), np.int64)
    groups[order] = np.cumsum(first)
    return groups


def _straighten(tangents: FloatArray, normals: FloatArray) -> FloatArray:
    """Return unit vectors (N, 3) at right angles to unit normals, closest to tangents; any where these have none."""
    straight = tangents - (tangents * normals).sum(axis=1, keepdims=True) * normals
    length = np.linalg.norm(straight, axis=1)
    degenerate = length <= 1e-6 * np.linalg.norm(tangents, axis=1)
    axes = np.eye(3)[np.abs(normals[degenerate]).argmin(axis=1)]
    straight[degenerate] = axes - (axes * normals[degenerate]).sum(axis=1, keepdims=True) * normals[degenerate]
    return normalize(straight)


# Culling: clusters of neighbors, each in a ball; a camera looks at those whose ball reaches into its cone.


@dataclass(frozen=True, slots=True, eq=False)
class Clusters:
    """Points or triangles in clusters of neighbors."""

    order: IndexArray
    """(N,) members, cluster after cluster."""
    starts: IndexArray
    """(C + 1,) first member of each cluster in `order`."""
    centers: FloatArray
    """(C, 3) of the balls."""
    radii: FloatArray
    """(C,) of the balls, which contain all corners of their members."""

    def find_in_cone(self, apex: FloatArray, axis: FloatArray, half_angle: float) -> IndexArray:
        """Return (M,) the members, ascending, of all clusters that reach into a cone of a half angle in radians."""
        slack = 1e-6  # bounds rounding: radians, and share of a radius or distance
        direction = self.centers - apex
        distance = np.linalg.norm(direction, axis=1)
        radii = self.radii * (1.0 + slack) + slack * distance
        outside = distance > radii
        angle = np.arctan2(np.linalg.norm(np.cross(direction, axis), axis=1), direction @ axis)
        reach = np.arcsin(np.clip(np.divide(radii, distance, out=np.ones_like(radii), where=outside), 0.0, 1.0))
        near = np.flatnonzero(~outside | (angle - reach <= half_angle + slack))
        if not len(near):
            return np.empty(0, np.int64)
        return np.sort(np.concatenate([self.order[self.starts[k] : self.starts[k + 1]] for k in near]))


def cluster(corners: FloatArray) -> Clusters:
    """Put points (K = 1) or triangles (K = 3), corners (N, K, 3), into clusters."""
    order = morton_order(corners.mean(axis=1))
    starts = np.append(np.arange(0, len(order), 256), len(order)).astype(np.int64)
    if not len(order):
        return Clusters(order, np.zeros(1, np.int64), np.empty((0, 3)), np.empty(0))
    lowest = np.minimum.reduceat(corners.min(axis=1)[order], starts[:-1])
    highest = np.maximum.reduceat(corners.max(axis=1)[order], starts[:-1])
    centers = 0.5 * (lowest + highest)
    own = np.repeat(centers, np.diff(starts), axis=0)[:, None, :]
    radii = np.maximum.reduceat(np.linalg.norm(corners[order] - own, axis=2).max(axis=1), starts[:-1])
    return Clusters(order, starts, centers, radii)


def morton_order(points: FloatArray) -> IndexArray:
    """Return the Morton order (N,) of points (N, 3), in which nearby points are mostly adjacent (Morton 1966)."""
    low = points.min(axis=0, initial=np.inf)
    span = max(float(np.max(points.max(axis=0, initial=-np.inf) - low, initial=0.0)), 1e-300)
    bits = 12
    grid = ((points - low) / span * (2**bits - 1)).astype(np.int64)
    code = np.zeros(len(points), np.int64)
    for bit in range(bits):
        for axis in range(3):
            code |= ((grid[:, axis] >> bit) & 1) << (3 * bit + axis)
    return np.argsort(code, kind="stable")
