"""The roughness of a surface: the curvature at each vertex against the pull of the photos."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sfm_app.geometry.triangles import bucket_order, unique_edges
from sfm_app.jit import kernel
from sfm_app.types.arrays import FloatArray, IndexArray


@dataclass(frozen=True, slots=True)
class FairnessOptions:
    """Weights of the fairness, and the end of its solver."""

    bend: float = 0.1
    """Usual distance of a vertex from the mean of its neighbors, in edges. Chosen on `ornament`."""
    crease: float = 0.25
    """Distance in edges from which the surface counts as creased. Chosen on `ornament`."""
    hold: float = 1e-3
    """Weight that holds a vertex in its place, per squared edge. Chosen by hand."""
    unseen: float = 10.0
    """The same for a vertex that no photo pulls. Chosen by hand."""
    steps: int = 60
    """Most steps of conjugate gradients. Chosen by hand."""
    accuracy: float = 1e-2
    """Share of the first residual at which they end; the next iteration of the refinement continues. Chosen by hand."""


OPTIONS = FairnessOptions()


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
        """Find the neighbors of `count` vertices; faces (T, 3) vertex indices."""
        edges, edge_of = unique_edges(faces)
        own, other = edges.T[::-1].ravel(), edges.T.ravel()  # lower neighbors first: they ascend at each vertex
        starts = np.concatenate([[0], np.cumsum(np.bincount(own, minlength=count))])
        inner = np.ones(count, np.bool_)
        inner[edges[np.bincount(edge_of.ravel(), minlength=len(edges)) != 2].ravel()] = False
        return cls(starts, other[bucket_order(own, count)], inner)

    def edge_lengths(self, vertices: FloatArray) -> FloatArray:
        """Return (V,) the mean length of the edges at each vertex (V, 3); 0 without any."""
        count = np.diff(self.starts)
        own = np.repeat(np.arange(len(vertices)), count)
        lengths = np.linalg.norm(vertices[own] - vertices[self.others], axis=1)
        return np.bincount(own, lengths, len(vertices)) / np.maximum(count, 1)


def find_displacements(
    vertices: FloatArray, normals: FloatArray, neighbors: Neighbors, pull: tuple[FloatArray, FloatArray],
    size: FloatArray, options: FairnessOptions = OPTIONS,
) -> FloatArray:  # fmt: skip
    """Return (V,) displacements along the normals.

    They minimize the sum of h d^2 - 2 g d over the vertices, plus the squared distances from the mean of the neighbors
    in units of `bend`; large distances, at creases, count less (Cauchy).

    The pull of the photos is g and h, `size` the mean length of the edges at each vertex, (V,) each.
    """
    g, h = pull
    bend = np.zeros(len(vertices))
    _bends(neighbors.starts, neighbors.others, neighbors.inner, vertices, normals, bend)
    weight = neighbors.inner / (options.bend * size) ** 2 / (1.0 + (bend / (options.crease * size)) ** 2)
    stiff = h + np.where(h > 0.0, options.hold, options.unseen) / size**2
    end = (options.steps, options.accuracy)
    displacements = np.zeros(len(vertices))
    _solve(neighbors.starts, neighbors.others, stiff, weight, g, bend, end, displacements)
    return displacements


@kernel
def _bends(
    starts: IndexArray, others: IndexArray, inner: NDArray[np.bool_], vertices: FloatArray, normals: FloatArray,
    bend: FloatArray,
) -> None:  # fmt: skip
    """Fill in the height of the mean of the neighbors above each inner vertex, along its normal."""
    for v in range(len(bend)):
        if not inner[v]:
            continue
        total = 0.0
        for k in range(starts[v], starts[v + 1]):
            for axis in range(3):
                total += (vertices[others[k], axis] - vertices[v, axis]) * normals[v, axis]
        bend[v] = total / (starts[v + 1] - starts[v])


@kernel
def _apply(
    starts: IndexArray, others: IndexArray, share: FloatArray, weight: FloatArray, d: FloatArray, scratch: FloatArray,
    out: FloatArray,
) -> None:  # fmt: skip
    """Fill in L' W L d, L d the mean of the neighbors less the vertex, by W's diagonal and one over their number."""
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
def _solve(  # noqa: PLR0913
    starts: IndexArray, others: IndexArray, stiff: FloatArray, weight: FloatArray, g: FloatArray, bend: FloatArray,
    end: tuple[int, float], d: FloatArray,
) -> None:  # fmt: skip
    """Solve (stiff + L' W L) d = g - L' W bend by conjugate gradients, scaled by the diagonal; sums run in order.

    `end` has the number of steps, and the share of the first residual at which they end.
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
    direction = r * scale
    tolerance = end[1] * end[1] * energy
    for _ in range(end[0]):
        if energy <= tolerance or energy <= 0.0:
            break
        _apply(starts, others, share, weight, direction, scratch, product)
        curvature = 0.0
        for v in range(count):
            product[v] += stiff[v] * direction[v]
            curvature += direction[v] * product[v]
        step = energy / curvature
        before, energy = energy, 0.0
        for v in range(count):
            d[v] += step * direction[v]
            r[v] -= step * product[v]
            energy += r[v] * r[v] * scale[v]
        ratio = energy / before
        for v in range(count):
            direction[v] = r[v] * scale[v] + ratio * direction[v]
