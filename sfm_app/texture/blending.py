"""Blending near seams: weights of the photos at the vertices, and offsets that remove color differences.

The weight of a photo at a vertex starts as the share of the vertex's triangles that it colors. It is diffused over a
few rings of vertices, as far as the photo sees them. Where two photos meet at a vertex, their colors should be equal:
offsets that vary slowly over the chart make them so (Lempitsky & Ivanov 2007; Waechter et al. 2014, section 3.2).
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sfm_app.texture.facets import NONE, Facets, IntArray, sum_at_vertices

FloatArray = NDArray[np.float64]

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


def blend_weights(chosen: IntArray, usable: NDArray[np.bool_], mesh: Facets) -> Blend:
    """Compute weights of the photos that blend them across seams.

    Args:
        chosen: (T,) photo of each triangle, -1 for none.
        usable: (P, T) whether a photo may be used for a triangle.
        mesh: the surface.
    """
    size = len(mesh.vertices)
    valence = np.maximum(sum_at_vertices(np.ones(len(chosen)), mesh.faces, size), 1.0)
    degree = np.maximum(np.bincount(mesh.edges.ravel(), minlength=size), 1)
    vertices, weights = [], []
    for photo in range(len(usable)):
        own = chosen == photo
        allowed = usable[photo] | own | (chosen == NONE)
        barred = sum_at_vertices((~allowed).astype(np.float64), mesh.faces, size) > 0
        share = sum_at_vertices(own.astype(np.float64), mesh.faces, size) / valence
        for _ in range(RINGS):
            share = np.where(barred, 0.0, _spread(share, mesh.edges, degree))
        at = np.flatnonzero(share > FAINT)
        vertices.append(at)
        weights.append(share[at])
    starts = np.concatenate([[0], np.cumsum([len(at) for at in vertices])]).astype(np.int64)
    vertex, weight = np.concatenate(vertices).astype(np.int64), np.concatenate(weights)
    total = np.bincount(vertex, weight, size)
    return Blend(starts, vertex, (weight / total[vertex]).astype(np.float32), np.zeros((len(vertex), 3), np.float32))


def _spread(share: FloatArray, edges: NDArray[np.int64], degree: NDArray[np.int64]) -> FloatArray:
    """Average each value with the mean of its neighboring vertices."""
    one, other = edges[:, 0], edges[:, 1]
    around = np.bincount(one, share[other], len(share)) + np.bincount(other, share[one], len(share))
    return np.asarray(0.5 * share + 0.5 * around / degree, np.float64)
