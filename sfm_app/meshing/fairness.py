"""A surface that is no rougher than photos ask for: the curvature at each vertex against the pull of the photos."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sfm_app.geometry.triangles import bucket_order, unique_edges
from sfm_app.jit import kernel
from sfm_app.types.arrays import FloatArray, IndexArray

BEND, CREASE = 0.1, 0.25
"""Usual distance of a vertex from the mean of its neighbors, and distance from which the surface counts as creased, in
edges. Chosen on `ornament`."""
HOLD, UNSEEN = 1e-3, 10.0
"""Weights that hold a vertex where it is, per squared edge: usual ones, and those that photos say nothing about. Chosen
by hand."""
STEPS, ACCURACY = 60, 1e-2
"""Most steps of conjugate gradients, and the share of the first residual at which they end: the next iteration of the
refinement goes on from there. Chosen by hand."""


@dataclass(frozen=True, slots=True, eq=False)
class Neighbors:
    """The neighbors of every vertex, as rows of a sparse matrix."""

    starts: IndexArray
    """(V + 1,) where the neighbors of a vertex begin."""
    others: IndexArray
    """(E,) neighbors."""
    inner: NDArray[np.bool_]
    """(V,) vertices that do not lie on the border of the surface."""

    @classmethod
    def from_faces(cls, faces: IndexArray, count: int) -> "Neighbors":
        """Find the neighbors of `count` vertices.

        Args:
            faces: (T, 3) vertex indices.
        """
        edges, edge_of = unique_edges(faces)
        own, other = edges.T[::-1].ravel(), edges.T.ravel()  # lower neighbors first: they ascend at each vertex
        starts = np.concatenate([[0], np.cumsum(np.bincount(own, minlength=count))])
        inner = np.ones(count, np.bool_)
        inner[edges[np.bincount(edge_of.ravel(), minlength=len(edges)) != 2].ravel()] = False
        return cls(starts, other[bucket_order(own, count)], inner)

    def edge_lengths(self, vertices: FloatArray) -> FloatArray:
        """Return (V,) the mean length of the edges at each vertex (V, 3); 0 without any."""
        found = np.zeros(len(vertices))
        _mean_lengths(self.starts, self.others, vertices, found)
        return found


def find_displacements(
    vertices: FloatArray, normals: FloatArray, around: Neighbors, pull: tuple[FloatArray, FloatArray], size: FloatArray
) -> FloatArray:
    """Return (V,) the displacements along the normals that suit the photos and keep the surface fair.

    They minimize the sum of h d^2 - 2 g d over the vertices, and of the squared distances from the mean of the
    neighbors, in usual ones; large distances, at creases, count less (Cauchy).

    Args:
        vertices, normals: (V, 3).
        pull: g and h of the photos, (V,) each.
        size: (V,) mean length of the edges at each vertex, > 0.
    """
    g, h = pull
    bend = np.zeros(len(vertices))
    _bends(around.starts, around.others, around.inner, vertices, normals, bend)
    weight = around.inner / (BEND * size) ** 2 / (1.0 + (bend / (CREASE * size)) ** 2)
    found = np.zeros(len(vertices))
    _solve(
        around.starts,
        around.others,
        h + np.where(h > 0.0, HOLD, UNSEEN) / size**2,
        weight,
        g,
        bend,
        (STEPS, ACCURACY),
        found,
    )
    return found


@kernel
def _mean_lengths(starts: IndexArray, others: IndexArray, vertices: FloatArray, found: FloatArray) -> None:
    for v in range(len(found)):
        total = 0.0
        for k in range(starts[v], starts[v + 1]):
            square = 0.0
            for axis in range(3):
                square += (vertices[v, axis] - vertices[others[k], axis]) ** 2
            total += np.sqrt(square)
        found[v] = total / max(starts[v + 1] - starts[v], 1)


@kernel
def _bends(
    starts: IndexArray, others: IndexArray, inner: NDArray[np.bool_], vertices: FloatArray, normals: FloatArray,
    found: FloatArray,
) -> None:  # fmt: skip
    """Fill in how far the mean of the neighbors lies above each inner vertex, along its normal."""
    for v in range(len(found)):
        if not inner[v]:
            continue
        total = 0.0
        for k in range(starts[v], starts[v + 1]):
            for axis in range(3):
                total += (vertices[others[k], axis] - vertices[v, axis]) * normals[v, axis]
        found[v] = total / (starts[v + 1] - starts[v])


@kernel
def _apply(
    starts: IndexArray, others: IndexArray, share: FloatArray, weight: FloatArray, d: FloatArray, scratch: FloatArray,
    out: FloatArray,
) -> None:  # fmt: skip
    """Fill in L' W L d; L d is the mean of the neighbors less the vertex.

    Args:
        share: (V,) one over the number of neighbors.
        weight: (V,) the diagonal of W; 0 where there are no neighbors.
        d: (V,).
        scratch: (V,), overwritten.
        out: (V,), overwritten.
    """
    for v in range(len(d)):
        out[v] = 0.0
        if weight[v] > 0.0:
            total = 0.0
            for k in range(starts[v], starts[v + 1]):
                total += d[others[k]]
            out[v] = weight[v] * (total * share[v] - d[v])
    _gather(starts, others, share, scratch, out)


@kernel
def _gather(starts: IndexArray, others: IndexArray, share: FloatArray, scratch: FloatArray, bends: FloatArray) -> None:
    """Replace bends by L' bends; those are 0 where the weight is. `scratch` (V,) is overwritten."""
    for v in range(len(bends)):
        scratch[v] = bends[v] * share[v]
    for v in range(len(bends)):
        total = -bends[v]
        for k in range(starts[v], starts[v + 1]):
            total += scratch[others[k]]
        bends[v] = total


@kernel
def _solve(
    starts: IndexArray, others: IndexArray, stiff: FloatArray, weight: FloatArray, g: FloatArray, bend: FloatArray,
    end: tuple[int, float], d: FloatArray,
) -> None:  # fmt: skip
    """Solve (stiff + L' W L) d = g - L' W bend by conjugate gradients, scaled by the diagonal; sums run in order.

    It ends after a number of steps, or at a share of the first residual.
    """
    count = len(d)
    share, scratch, diagonal, r = np.empty(count), np.empty(count), np.empty(count), np.empty(count)
    for v in range(count):
        share[v] = 1.0 / max(starts[v + 1] - starts[v], 1)
        scratch[v] = weight[v] * share[v] * share[v]
    for v in range(count):
        diagonal[v] = stiff[v] + weight[v]
        for k in range(starts[v], starts[v + 1]):
            diagonal[v] += scratch[others[k]]
    scale, product = 1.0 / diagonal, weight * bend
    _gather(starts, others, share, scratch, product)
    energy = 0.0
    for v in range(count):
        r[v] = g[v] - product[v]
        energy += r[v] * r[v] * scale[v]
    way = r * scale
    enough = end[1] * end[1] * energy
    for _ in range(end[0]):
        if energy <= enough or energy <= 0.0:
            break
        _apply(starts, others, share, weight, way, scratch, product)
        along = 0.0
        for v in range(count):
            product[v] += stiff[v] * way[v]
            along += way[v] * product[v]
        step = energy / along
        before, energy = energy, 0.0
        for v in range(count):
            d[v] += step * way[v]
            r[v] -= step * product[v]
            energy += r[v] * r[v] * scale[v]
        ratio = energy / before
        for v in range(count):
            way[v] = r[v] * scale[v] + ratio * way[v]
