"""The triangles of a surface and their neighbors."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sfm_app.geometry.triangles import Clusters, bucket_order, cluster, unique_edges
from sfm_app.jit import kernel
from sfm_app.types import Surface
from sfm_app.types.arrays import FloatArray, IndexArray

IntArray = NDArray[np.int32]

NONE = -1


@dataclass(frozen=True, slots=True, eq=False)
class Facets:
    """A surface with the tables of texturing."""

    surface: Surface
    neighbors: IntArray
    """(T, 3) triangle across edge k, from corner k to corner k + 1; -1 at borders and where more than two meet."""
    edges: IndexArray
    """(E, 2) vertices of every edge, each once, smaller first."""
    spacing: float
    """Median length of an edge."""
    clusters: Clusters
    fan_starts: IndexArray
    """(V + 1,) The triangles at vertex v are fans[fan_starts[v]] to fans[fan_starts[v + 1] - 1]."""
    fans: IndexArray
    """(3 T,)"""

    @property
    def vertices(self) -> FloatArray:
        """(V, 3)."""
        return self.surface.vertices

    @property
    def faces(self) -> IndexArray:
        """(T, 3) vertex indices."""
        return self.surface.faces

    @property
    def valence(self) -> IndexArray:
        """(V,) number of triangles at each vertex."""
        return np.asarray(np.diff(self.fan_starts))

    def faces_at(self, vertices: IndexArray) -> IndexArray:
        """Return (M,) the triangles at vertices (N,), each once, ascending."""
        triangles = self.fans[ranges(self.fan_starts[vertices], self.fan_starts[vertices + 1])]
        return distinct(triangles, len(self.faces))

    def edges_among(self, vertices: IndexArray) -> IndexArray:
        """Return (M,) the edges between ascending vertices (N,), ascending."""
        first, end = (np.searchsorted(self.edges[:, 0], vertices, side) for side in ("left", "right"))
        edges = ranges(first, end)
        other = self.edges[edges, 1]
        at = np.minimum(np.searchsorted(vertices, other), max(len(vertices) - 1, 0))
        return np.asarray(edges[vertices[at] == other]) if len(edges) else edges


def facets(surface: Surface) -> Facets:
    """Build the tables of neighbors and edges."""
    edges, edge_of = unique_edges(surface.faces)
    sides, edge_of = np.arange(edge_of.size), edge_of.ravel()
    # the two sides of an edge add up to the sum of their numbers
    both = np.bincount(edge_of, sides, len(edges))[edge_of].astype(np.int64)
    inner = np.bincount(edge_of, minlength=len(edges))[edge_of] == 2
    neighbors = np.where(inner, (both - sides) // 3, NONE).astype(np.int32)
    lengths = np.linalg.norm(surface.vertices[edges[:, 0]] - surface.vertices[edges[:, 1]], axis=1)
    spacing = float(np.median(lengths)) if len(lengths) else 0.0
    corners, count = surface.faces.ravel(), len(surface.vertices)
    fans = bucket_order(corners, count) // 3
    fan_starts = np.concatenate([[0], np.cumsum(np.bincount(corners, minlength=count))])
    near = cluster(surface.vertices[surface.faces])
    return Facets(surface, neighbors.reshape(-1, 3), edges, spacing, near, fan_starts.astype(np.int64), fans)


def distinct(numbers: IndexArray, size: int) -> IndexArray:
    """Return (M,) distinct values of numbers (N,) in [0, size), ascending."""
    if 64 * len(numbers) < size:  # sorting few numbers is faster than marking them
        return np.unique(numbers)
    is_present = np.zeros(size, np.bool_)
    is_present[numbers] = True
    return np.flatnonzero(is_present)


def ranges(starts: IndexArray, ends: IndexArray) -> IndexArray:
    """Return (M,) the concatenated ranges from each start (N,) to its end (N,), exclusive."""
    counts = ends - starts
    total = np.cumsum(counts)
    return np.asarray(np.arange(total[-1] if len(total) else 0) + np.repeat(starts - total + counts, counts))


def components(group: IndexArray, neighbors: IntArray) -> tuple[IntArray, int]:
    """Find connected triangles of equal group (T,): component (T,), -1 where the group is -1, and their number."""
    of = np.full(len(group), NONE, np.int32)
    return of, _flood(group, neighbors, of)


@kernel
def _flood(group: IndexArray, neighbors: IntArray, of: IntArray) -> int:
    stack = np.empty(len(group), np.int64)
    count = 0
    for seed in range(len(group)):
        if group[seed] == NONE or of[seed] != NONE:
            continue
        stack[0], top = seed, 1
        of[seed] = count
        while top:
            top -= 1
            f = stack[top]
            for k in range(3):
                g = neighbors[f, k]
                if g != NONE and of[g] == NONE and group[g] == group[f]:
                    of[g] = count
                    stack[top] = g
                    top += 1
        count += 1
    return count
