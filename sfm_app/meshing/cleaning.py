"""Clean meshes: no islands, doubtful parts, ragged borders, or edges of more than two triangles.

SciPy is imported where it is used: a program that only estimates fundamental matrices starts without it.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sfm_app.geometry.triangles import areas, bucket_order, select_faces, split_fans, unique_edges
from sfm_app.meshing.visibility import CONFIRMED, EMPTY, SEEN_THROUGH
from sfm_app.types import Surface
from sfm_app.types.arrays import FloatArray, IndexArray

Edges = tuple[IndexArray, IndexArray]
"""The result of `unique_edges`."""

MIN_HEIGHT = 1e-7
"""A triangle is degenerate below this height, as a share of the surface's size. By definition: single precision."""


def drop_islands(surface: Surface, min_share: float) -> Surface:
    """Drop connected parts with less than `min_share` of all triangles, in [0, 1]."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    if not len(surface.faces):
        return surface
    a, b, c = surface.faces.T
    rows, cols = np.concatenate([a, b]), np.concatenate([b, c])
    size = len(surface.vertices)
    _, part = connected_components(coo_array((np.ones(len(rows), bool), (rows, cols)), (size, size)), directed=False)
    part_of_face = part[a]
    triangles = np.bincount(part_of_face)
    return select_faces(surface, triangles[part_of_face] >= min_share * len(surface.faces))


def make_manifold(surface: Surface) -> Surface:
    """Return the surface as an oriented manifold: at most two triangles at an edge, one fan at a vertex.

    Degenerate, non-finite and duplicate triangles are removed. Where more than two triangles share an edge, or two run
    along it in the same direction, the smallest are removed. Vertices where fans only touch are split.
    """
    surface = select_faces(surface, _proper_faces(surface))
    while len(surface.faces):
        bad = _excess_faces(surface)
        if not bad.any():
            break
        surface = select_faces(surface, ~bad)
    return split_fans(surface)


def _proper_faces(surface: Surface) -> NDArray[np.bool_]:
    """Mark triangles that are finite and not degenerate, each set of corners once, (T,)."""
    corners = surface.vertices[surface.faces]
    sides = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
    area = areas(surface.vertices, surface.faces)
    finite = np.isfinite(area)
    size = np.ptp(surface.vertices[np.isfinite(surface.vertices).all(axis=1)], axis=0).max(initial=0.0)
    ranked, order = np.sort(surface.faces, axis=1), np.arange(len(surface.faces))
    for corner in (2, 1, 0):
        order = order[bucket_order(ranked[order, corner], len(surface.vertices))]
    proper = np.ones(len(surface.faces), bool)
    proper[order[1:]] = (ranked[order[1:]] != ranked[order[:-1]]).any(axis=1)
    return np.asarray(proper & finite & (2.0 * area > MIN_HEIGHT * size * sides))


def _excess_faces(surface: Surface) -> NDArray[np.bool_]:
    """Mark the smallest triangle at every edge with too many triangles or two in the same direction, (T,)."""
    edges, edge_of = unique_edges(surface.faces)
    forward = surface.faces < np.roll(surface.faces, -1, axis=1)
    uses = np.stack([np.bincount(edge_of[same], minlength=len(edges)) for same in (forward, ~forward)])
    wrong = np.asarray((uses > 1).any(axis=0))
    bad = np.zeros(len(surface.faces), bool)
    if wrong.any():
        area = areas(surface.vertices, surface.faces)
        face, side = np.nonzero(wrong[edge_of])
        order = np.lexsort((face, area[face], edge_of[face, side]))
        at = edge_of[face, side][order]
        bad[face[order][np.diff(at, prepend=-1) > 0]] = True
    return bad


@dataclass(frozen=True, slots=True)
class TrimOptions:
    """Thresholds of the trimming."""

    smoothing: int = 20
    """Iterations of averaging over neighbors that smooth the border. Chosen by hand."""
    most_free: float = 0.1
    """A gap is not bridged if photos see through this share of it: it is free space beside an edge. Chosen by hand."""
    least_confirmed: float = 0.25
    """Least share of photos that confirm a vertex among those that confirm it or have an empty depth map there. Flakes
    of sky beside outlines are never seen through, and with more photos, one or two confirm more of them. Chosen by
    hand."""


TRIM = TrimOptions()


@dataclass(slots=True, eq=False)
class Support:
    """Counts of photos that confirm each vertex of a surface, see through it, or have an empty depth map there."""

    confirmed: NDArray[np.int32]
    """(V,)."""
    seen_through: NDArray[np.int32]
    """(V,)."""
    empty: NDArray[np.int32]
    """(V,)."""

    @classmethod
    def zeros(cls, count: int) -> "Support":
        """Return zero counts for `count` vertices."""
        return cls(*(np.zeros(count, np.int32) for _ in range(3)))

    def add(self, at: IndexArray, verdict: NDArray[np.uint8]) -> None:
        """Add the verdicts (N,) of one photo, from `judge`, on vertices (N,), each once."""
        self.confirmed[at] += verdict == CONFIRMED
        self.seen_through[at] += verdict == SEEN_THROUGH
        self.empty[at] += verdict == EMPTY

    @property
    def is_free(self) -> NDArray[np.bool_]:
        """(V,) whether more photos see through a vertex than confirm it."""
        return np.asarray(self.seen_through > self.confirmed)


def trim(surface: Surface, support: Support, max_gap_triangles: float, least: float) -> Surface:
    """Keep the parts that photos confirm and do not see through, bridge small gaps, and smooth the border."""
    enough = support.confirmed >= TRIM.least_confirmed * (support.confirmed + support.empty)
    is_supported = (support.confirmed > 0) & ~support.is_free & enough
    sign, (edges, edge_of) = np.where(is_supported, 1.0, -1.0), unique_edges(surface.faces)
    bridged = bridge_gaps(surface, edges, sign, support.is_free, max_gap_triangles)
    whole = bridge_gaps(surface, edges, smooth_support(edges, bridged), support.is_free, max_gap_triangles)
    return cut(surface, drop_doubtful_parts(edges, whole, support.confirmed, least), (edges, edge_of))


def bridge_gaps(
    surface: Surface, edges: IndexArray, support: FloatArray, free: NDArray[np.bool_], max_width: float
) -> FloatArray:
    """Add support to small unsupported patches, by the edges (E, 2), that hardly any photo sees through.

    The support (V,) is positive where photos confirm the surface; `free` marks where they see through it. It becomes 1
    on patches of at most `max_width`, in edge lengths of their rim; their length is not limited.
    """
    from scipy.sparse.csgraph import connected_components, dijkstra

    inside = support > 0
    if not inside.any() or inside.all():
        return support
    length = np.linalg.norm(surface.vertices[edges[:, 0]] - surface.vertices[edges[:, 1]], axis=1)
    ends_inside = inside[edges].sum(axis=1)
    outer = edges[ends_inside == 0]
    count, patch = connected_components(_graph(outer, len(support)), directed=False)
    rim, rim_length = edges[ends_inside == 1], length[ends_inside == 1]
    rim_patch = patch[np.where(inside[rim[:, 0]], rim[:, 1], rim[:, 0])]
    scale = np.bincount(rim_patch, rim_length, count) / np.maximum(np.bincount(rim_patch, minlength=count), 1)
    graph = _graph(edges, len(support), length)
    reach = dijkstra(graph, directed=False, indices=np.flatnonzero(inside), min_only=True)
    depth = np.zeros(count)
    np.maximum.at(depth, patch, np.where(inside, 0.0, reach))
    free_share = np.bincount(patch, free, count) / np.bincount(patch, minlength=count)
    bridged = (2.0 * depth <= max_width * scale) & (free_share < TRIM.most_free)
    return np.where(~inside & bridged[patch], 1.0, support)


def drop_doubtful_parts(
    edges: IndexArray, support: FloatArray, confirmed: NDArray[np.int32], least: float
) -> FloatArray:
    """Remove the support of parts, connected by edges (E, 2), that too few photos confirm on average.

    Examples are fragments around outlines: two or three photos agree by chance, and the gaps between are bridged. The
    mean number of photos that confirm a vertex, by their number (V,) at each, has to reach `least`.
    """
    from scipy.sparse.csgraph import connected_components

    inside = support > 0
    count, part = connected_components(_graph(edges[inside[edges].all(axis=1)], len(support)), directed=False)
    mean = np.bincount(part, confirmed, count) / np.bincount(part, minlength=count)
    return np.where(inside & (mean[part] < least), -1.0, support)


def smooth_support(edges: IndexArray, support: FloatArray) -> FloatArray:
    """Average the support (V,) over each vertex and its neighbors by the edges (E, 2), to smooth the border."""
    graph = _graph(edges, len(support))
    neighbors = np.maximum(np.bincount(edges.ravel(), minlength=len(support)), 1)
    for _ in range(TRIM.smoothing):
        support = 0.5 * support + 0.5 * (graph @ support + graph.T @ support) / neighbors
    return support


def _graph(edges: IndexArray, size: int, weights: FloatArray | None = None) -> Any:
    from scipy.sparse import coo_array

    return coo_array(
        (np.ones(len(edges)) if weights is None else weights, (edges[:, 0], edges[:, 1])), (size, size)
    ).tocsr()


def cut(surface: Surface, support: FloatArray, known: Edges | None = None) -> Surface:
    """Return the part of a surface where the support (V,), linear along the edges, is positive; split its border."""
    edges, edge_of = known or unique_edges(surface.faces)
    support = np.where(support == 0, -1e-9, support)
    a, b = support[edges].T
    crossed = (a > 0) != (b > 0)
    share = np.divide(a, a - b, out=np.zeros_like(a), where=crossed)[crossed, None]
    first, second = edges[crossed].T
    vertices = surface.vertices[first] * (1 - share) + surface.vertices[second] * share
    colors = surface.colors[first] * (1 - share) + surface.colors[second] * share
    new = np.full(len(edges), -1)
    new[crossed] = len(surface.vertices) + np.arange(len(vertices))
    faces = _split(surface.faces, new[edge_of], support[surface.faces] > 0)
    all_colors = np.concatenate([surface.colors, np.rint(colors).astype(np.uint8)])
    extended = Surface(np.concatenate([surface.vertices, vertices]), faces, all_colors)
    return select_faces(extended, np.ones(len(faces), bool))


def _split(faces: IndexArray, middle: IndexArray, inside: NDArray[np.bool_]) -> IndexArray:
    """Return triangles inside, and the inner parts of others; `middle` (T, 3) has the new vertices on ab, bc, ca."""
    parts = [faces[inside.all(axis=1)]]
    count = inside.sum(axis=1)
    for corner in range(3):
        a, b, c = corner, (corner + 1) % 3, (corner + 2) % 3
        one = (count == 1) & inside[:, a]
        parts.append(np.stack([faces[one, a], middle[one, a], middle[one, c]], axis=1))
        two = (count == 2) & ~inside[:, a]
        parts.append(np.stack([middle[two, a], faces[two, b], faces[two, c]], axis=1))
        parts.append(np.stack([middle[two, a], faces[two, c], middle[two, c]], axis=1))
    return np.concatenate(parts)
