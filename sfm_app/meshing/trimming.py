"""Where a surface ends: small gaps in what is measured are bridged, and the border is cut along a smooth line.

SciPy is imported where it is used: a program that only estimates fundamental matrices starts without it.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sfm_app.geometry.triangles import edges_of, select_faces
from sfm_app.meshing.visibility import CONFIRMED, EMPTY, SEEN_THROUGH
from sfm_app.types import Surface

FloatArray = NDArray[np.float64]
IndexArray = NDArray[np.int64]

SMOOTHING = 20
"""Averages over neighbors that take the fringe off the border."""
MAX_FREE = 0.1
"""A gap is not bridged where photos see through this share of it: then it is the way around an edge, not a hole."""

MIN_SHARE = 0.25
"""Of the photos that should see a vertex so many confirm it; the depth maps of the others are empty there. Flakes of
sky beside outlines are never seen through, and the more photos, the more of them are confirmed by one or two."""


@dataclass(slots=True, eq=False)
class Support:
    """How many photos confirm each vertex of a surface, see through it, and know nothing where it should be."""

    confirmed: NDArray[np.int32]
    """(V,)."""
    through: NDArray[np.int32]
    """(V,)."""
    empty: NDArray[np.int32]
    """(V,)."""

    @classmethod
    def none(cls, count: int) -> "Support":
        """Make the arrays of `count` vertices that no photo sees yet."""
        return cls(*(np.zeros(count, np.int32) for _ in range(3)))

    def add(self, verdict: NDArray[np.uint8]) -> None:
        """Add what one photo says, see `judge`."""
        self.confirmed += verdict == CONFIRMED
        self.through += verdict == SEEN_THROUGH
        self.empty += verdict == EMPTY

    @property
    def free(self) -> NDArray[np.bool_]:
        """(V,) whether more photos see through a vertex than confirm it."""
        return np.asarray(self.through > self.confirmed)

    @property
    def believed(self) -> NDArray[np.bool_]:
        """(V,) whether enough of the photos that would see a vertex confirm it."""
        enough = self.confirmed >= MIN_SHARE * (self.confirmed + self.empty)
        return np.asarray((self.confirmed > 0) & ~self.free & enough)


def trim(surface: Surface, support: Support, max_gap_triangles: float, least: float) -> Surface:
    """Keep what photos confirm and do not see through, and the small gaps in it; the border is a smooth line.

    Args:
        surface: closed, as Poisson gives it.
        support: of its vertices.
        max_gap_triangles: as for `bridge_gaps`.
        least: as for `drop_doubtful`.
    """
    sign = np.where(support.believed, 1.0, -1.0)
    smooth = smooth_support(surface, bridge_gaps(surface, sign, support.free, max_gap_triangles), SMOOTHING)
    whole = bridge_gaps(surface, smooth, support.free, max_gap_triangles)
    return cut(surface, drop_doubtful(surface, whole, support.confirmed, least))


def bridge_gaps(surface: Surface, support: FloatArray, free: NDArray[np.bool_], max_width: float) -> FloatArray:
    """Return support the unsupported patches that are small and not mostly seen through.

    Args:
        surface: closed or open.
        support: (V,) positive where photos confirm the surface, negative where none does.
        free: (V,) where photos see through the surface.
        max_width: of a patch that is bridged, in edges of the surface around it; it may be longer than wide.

    Returns:
        (V,) support, 1 on the patches bridged.
    """
    from scipy.sparse.csgraph import connected_components, dijkstra

    inside = support > 0
    if not inside.any() or inside.all():
        return support
    edges, _ = edges_of(surface.faces)
    length = np.linalg.norm(surface.vertices[edges[:, 0]] - surface.vertices[edges[:, 1]], axis=1)
    ends_inside = inside[edges].sum(axis=1)
    outer = edges[ends_inside == 0]
    count, patch = connected_components(_graph(outer, len(support)), directed=False)
    rim, rim_length = edges[ends_inside == 1], length[ends_inside == 1]
    rim_patch = patch[np.where(inside[rim[:, 0]], rim[:, 1], rim[:, 0])]
    scale = np.bincount(rim_patch, rim_length, count) / np.maximum(np.bincount(rim_patch, minlength=count), 1)
    ways = _graph(edges, len(support), length)
    reach = dijkstra(ways, directed=False, indices=np.flatnonzero(inside), min_only=True)
    depth = np.zeros(count)
    np.maximum.at(depth, patch, np.where(inside, 0.0, reach))
    free_share = np.bincount(patch, free, count) / np.bincount(patch, minlength=count)
    bridged = (2.0 * depth <= max_width * scale) & (free_share < MAX_FREE)
    return np.where(~inside & bridged[patch], 1.0, support)


def drop_doubtful(surface: Surface, support: FloatArray, confirmed: NDArray[np.int32], least: float) -> FloatArray:
    """Take the support from connected parts that too few photos confirm on average.

    Crumbs around outlines are like that: chance agreement of two or three photos, and the gaps between them bridged.

    Args:
        surface: its edges connect the parts.
        support: (V,) positive where photos confirm the surface.
        confirmed: (V,) photos that confirm each vertex.
        least: photos on average, >= 0.
    """
    from scipy.sparse.csgraph import connected_components

    edges, _ = edges_of(surface.faces)
    inside = support > 0
    count, part = connected_components(_graph(edges[inside[edges].all(axis=1)], len(support)), directed=False)
    mean = np.bincount(part, confirmed, count) / np.bincount(part, minlength=count)
    return np.where(inside & (mean[part] < least), -1.0, support)


def smooth_support(surface: Surface, support: FloatArray, steps: int) -> FloatArray:
    """Return (V,) support averaged over the vertex and its neighbors: the border loses its fringe.

    Args:
        surface: its edges are used.
        support: (V,) positive where photos confirm the surface.
        steps: averages, >= 0.
    """
    edges, _ = edges_of(surface.faces)
    graph = _graph(edges, len(support))
    neighbors = np.maximum(np.bincount(edges.ravel(), minlength=len(support)), 1)
    for _ in range(steps):
        support = 0.5 * support + 0.5 * (graph @ support + graph.T @ support) / neighbors
    return support


def _graph(edges: IndexArray, size: int, weights: FloatArray | None = None) -> Any:
    from scipy.sparse import coo_array

    return coo_array(
        (np.ones(len(edges)) if weights is None else weights, (edges[:, 0], edges[:, 1])), (size, size)
    ).tocsr()


def cut(surface: Surface, support: FloatArray) -> Surface:
    """Return the part of a surface where the support, linear along the edges, is positive.

    Triangles on the border are split.

    Args:
        surface: any.
        support: (V,).
    """
    edges, edge_of = edges_of(surface.faces)
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
    """Return triangles whose corners are inside, and what is left of those with one or two.

    `middle` (T, 3) on ab, bc, ca.
    """
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
