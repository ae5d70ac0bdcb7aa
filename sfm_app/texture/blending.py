"""Blending near seams: weights of the photos at the vertices, and offsets that remove color differences.

The weight of a photo at a vertex starts as the share of the vertex's triangles that it colors. It is diffused over a
few rings of vertices, as far as the photo sees them. Where two photos meet at a vertex, their colors should be equal:
offsets that vary slowly over the chart make them so (Lempitsky & Ivanov 2007; Waechter et al. 2014, section 3.2).
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sfm_app.texture.appearance.sightings import Sightings
from sfm_app.texture.facets import NONE, Facets, IntArray, distinct

FloatArray = NDArray[np.float64]
IndexArray = NDArray[np.int64]

RINGS = 3
"""Rings of vertices on either side of a seam over which photos are blended."""
FAINT = 0.02
"""Smaller weights are dropped."""


@dataclass(frozen=True, slots=True, eq=False)
class Blend:
    """Nodes, each a photo at a vertex. Those of photo p are the rows starts[p] to starts[p + 1] - 1."""

    starts: NDArray[np.int64]
    """(P + 1,)"""
    vertex: NDArray[np.int64]
    """(N,) ascending within a photo."""
    weight: NDArray[np.float32]
    """(N,) weight of the photo at the vertex; the weights at each vertex sum to 1."""
    offset: NDArray[np.float32]
    """(N, 3) gray levels added to the photo at the vertex after gain correction."""

    def photo_rows(self, photo: int) -> slice:
        """Return the rows of a photo."""
        return slice(int(self.starts[photo]), int(self.starts[photo + 1]))


def blend_weights(chosen: IntArray, seen: Sightings, mesh: Facets) -> Blend:
    """Compute weights of the photos that blend them across seams.

    Args:
        chosen: (T,) photo of each triangle, -1 for none.
        seen: which photos see which triangles; not used where the worth is negative.
        mesh: the surface.
    """
    size = len(mesh.vertices)
    degree = np.maximum(np.bincount(mesh.edges.ravel(), minlength=size), 1)
    order = np.argsort(chosen, kind="stable")
    starts = np.searchsorted(chosen[order], np.arange(seen.photos + 1))
    vertices, weights = [], []
    for photo in range(seen.photos):
        own = order[starts[photo] : starts[photo + 1]]
        at, share = _photo_weights(photo, own, chosen, seen, mesh, degree)
        vertices.append(at[share > FAINT])
        weights.append(share[share > FAINT])
    rows = np.concatenate([[0], np.cumsum([len(at) for at in vertices])]).astype(np.int64)
    vertex, weight = np.concatenate(vertices).astype(np.int64), np.concatenate(weights)
    total = np.bincount(vertex, weight, size)
    return Blend(rows, vertex, (weight / total[vertex]).astype(np.float32), np.zeros((len(vertex), 3), np.float32))


def _photo_weights(
    photo: int, own: IndexArray, chosen: IntArray, seen: Sightings, mesh: Facets, degree: IndexArray
) -> tuple[IndexArray, FloatArray]:
    """Return the vertices (N,) to which the share of a photo spreads, ascending, and its share (N,) at each.

    Args:
        photo: its number.
        own: (M,) triangles that it colors, ascending.
        chosen: (T,) photo of each triangle.
        seen: which photos see which triangles.
        mesh: the surface.
        degree: (V,) number of edges at each vertex.
    """
    at = distinct(mesh.faces[own].ravel(), len(mesh.vertices))
    for _ in range(RINGS):
        at = distinct(mesh.faces[mesh.faces_at(at)].ravel(), len(mesh.vertices))
    near = mesh.faces_at(at)
    allowed = np.isin(near, seen.usable_faces(photo), assume_unique=True) | np.isin(chosen[near], (photo, NONE))
    corners = np.searchsorted(at, mesh.faces[near][~allowed].ravel()).clip(max=max(len(at) - 1, 0))
    barred = np.zeros(len(at), np.bool_)
    barred[corners[at[corners] == mesh.faces[near][~allowed].ravel()]] = True
    count = np.bincount(np.searchsorted(at, mesh.faces[own].ravel()), minlength=len(at)).astype(np.float64)
    share = count / np.maximum(mesh.valence[at], 1.0)
    edges = np.searchsorted(at, mesh.edges[mesh.edges_among(at)])
    for _ in range(RINGS):
        share = np.where(barred, 0.0, _spread(share, edges, degree[at]))
    return at, share


def _spread(share: FloatArray, edges: IndexArray, degree: IndexArray) -> FloatArray:
    """Average each value with the mean of its neighboring vertices."""
    one, other = edges[:, 0], edges[:, 1]
    around = np.bincount(one, share[other], len(share)) + np.bincount(other, share[one], len(share))
    return np.asarray(0.5 * share + 0.5 * around / degree, np.float64)
