"""Weights that blend photos at seams, and offsets that level their colors; `pages` applies both."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from sfm_app.jit import kernel
from sfm_app.texture.sightings import NONE, Facets, IntArray, Sightings, distinct
from sfm_app.types.arrays import FloatArray, IndexArray


@dataclass(frozen=True, slots=True)
class SeamOptions:
    """Weights of the blend, and of the least squares of offsets."""

    rings: int = 3
    """Rings of vertices on either side of a seam over which photos are blended."""
    faint: float = 0.02
    """Smaller weights are dropped."""
    stiffness: float = 4.0
    """Weight of differences of offsets along a chart, relative to 1 for differences at seams."""
    prior: float = 1e-3
    """Weight of zero offsets."""


OPTIONS = SeamOptions()

# Blending near seams: weights of the photos at the vertices, and offsets that remove color differences.
# The weight of a photo at a vertex starts as its share of the vertex's triangles. It is diffused over a few rings
# of vertices with usable views. Where two photos meet at a vertex, slowly varying offsets make their colors equal
# (Lempitsky & Ivanov 2007; Waechter et al. 2014, section 3.2).


@dataclass(frozen=True, slots=True, eq=False)
class Blend:
    """Nodes, each a photo at a vertex. Photo p has the rows starts[p] to starts[p + 1] - 1."""

    starts: IndexArray
    """(P + 1,)"""
    vertex: IndexArray
    """(N,) ascending within a photo."""
    weight: NDArray[np.float32]
    """(N,) weight of the photo at the vertex; the weights at each vertex sum to 1."""
    offset: NDArray[np.float32]
    """(N, 3) gray levels added to the photo at the vertex after gain correction."""

    def photo_rows(self, photo: int) -> slice:
        """Return the rows of a photo."""
        return slice(int(self.starts[photo]), int(self.starts[photo + 1]))


def blend_weights(chosen: IntArray, sightings: Sightings, mesh: Facets) -> Blend:
    """Compute weights that blend the photos of triangles (T,), -1 for none, across seams."""
    size = len(mesh.vertices)
    degree = np.maximum(np.bincount(mesh.edges.ravel(), minlength=size), 1)
    order = np.argsort(chosen, kind="stable")
    starts = np.searchsorted(chosen[order], np.arange(sightings.photos + 1))
    vertices, weights = [], []
    for photo in range(sightings.photos):
        own = order[starts[photo] : starts[photo + 1]]
        at, share = _photo_weights(photo, own, chosen, sightings, mesh, degree)
        vertices.append(at[share > OPTIONS.faint])
        weights.append(share[share > OPTIONS.faint])
    rows = np.concatenate([[0], np.cumsum([len(at) for at in vertices])]).astype(np.int64)
    vertex, weight = np.concatenate(vertices).astype(np.int64), np.concatenate(weights)
    total = np.bincount(vertex, weight, size)
    return Blend(rows, vertex, (weight / total[vertex]).astype(np.float32), np.zeros((len(vertex), 3), np.float32))


def _photo_weights(
    photo: int, own: IndexArray, chosen: IntArray, sightings: Sightings, mesh: Facets, degree: IndexArray
) -> tuple[IndexArray, FloatArray]:
    """Return the vertices (N,) near the `own` triangles of a photo, ascending, and its share; degrees are (V,)."""
    at = distinct(mesh.faces[own].ravel(), len(mesh.vertices))
    for _ in range(OPTIONS.rings):
        at = distinct(mesh.faces[mesh.faces_at(at)].ravel(), len(mesh.vertices))
    near = mesh.faces_at(at)
    rows = sightings.rows(photo)
    usable = sightings.face[rows][sightings.score[rows] > 0].astype(np.int64)
    allowed = np.isin(near, usable, assume_unique=True) | np.isin(chosen[near], (photo, NONE))
    corners = np.searchsorted(at, mesh.faces[near][~allowed].ravel()).clip(max=max(len(at) - 1, 0))
    barred = np.zeros(len(at), np.bool_)
    barred[corners[at[corners] == mesh.faces[near][~allowed].ravel()]] = True
    count = np.bincount(np.searchsorted(at, mesh.faces[own].ravel()), minlength=len(at)).astype(np.float64)
    share = count / np.maximum(mesh.valence[at], 1.0)
    one, other = np.searchsorted(at, mesh.edges[mesh.edges_among(at)]).T
    for _ in range(OPTIONS.rings):
        total = np.bincount(one, share[other], len(share)) + np.bincount(other, share[one], len(share))
        share = np.where(barred, 0.0, 0.5 * share + 0.5 * total / degree[at])
    return at, share


def level_seams(blend: Blend, sightings: Sightings, gains: FloatArray, mesh: Facets) -> Blend:
    """Estimate the offsets of a blend by least squares, given the gains (P, 3) of the photos."""
    first, second, gap = _gaps(blend, sightings, gains, mesh)
    start, end = _ties(blend, mesh)
    right = np.zeros((len(blend.vertex), 3))
    for channel in range(3):
        right[:, channel] += np.bincount(first, gap[:, channel], len(right))
        right[:, channel] -= np.bincount(second, gap[:, channel], len(right))
    weights = np.concatenate([np.ones(len(first)), np.full(len(start), OPTIONS.stiffness)])
    offsets = solve_ties(np.concatenate([first, start]), np.concatenate([second, end]), weights, OPTIONS.prior, right)
    return replace(blend, offset=offsets.astype(np.float32))


def solve_ties(
    one: IndexArray, other: IndexArray, weights: FloatArray, hold: float | FloatArray, right: FloatArray
) -> FloatArray:
    """Solve (graph Laplacian of the edges + hold) x = right (N, 3) by conjugate gradients; hold is a number or (N,)."""
    from scipy.sparse import coo_matrix

    size = len(right)
    diagonal = np.bincount(one, weights, size) + np.bincount(other, weights, size) + hold
    rows, columns = np.concatenate([one, other]), np.concatenate([other, one])
    ties = coo_matrix((np.concatenate([weights, weights]), (rows, columns)), shape=(size, size)).tocsr()
    x = np.zeros((size, 3))
    _solve(ties.indptr, ties.indices, ties.data, np.asarray(diagonal), np.ascontiguousarray(right), x)
    return x


@kernel
def _solve(
    starts: NDArray[np.int32], others: NDArray[np.int32], weights: FloatArray, diagonal: FloatArray, right: FloatArray,
    x: FloatArray,
) -> None:  # fmt: skip
    """Solve (diagonal - weights) x = right by at most 100 steps of conjugate gradients, scaled by the diagonal."""
    size, channels = len(right), 3
    residual, direction, product = right.copy(), np.empty_like(right), np.empty_like(right)
    tolerance, step = np.zeros(channels), np.zeros(channels)
    energy = _precondition(residual, diagonal, direction)
    for c in range(channels):  # assigning rows compiles for a second
        tolerance[c] = 1e-2 * 1e-2 * energy[c]
    for _ in range(100):
        if energy[0] <= tolerance[0] and energy[1] <= tolerance[1] and energy[2] <= tolerance[2]:
            break
        curvature = _multiply(starts, others, weights, diagonal, direction, product)
        before = energy
        for c in range(channels):
            step[c] = energy[c] / curvature[c] if curvature[c] > 0.0 else 0.0
        for n in range(size):
            for c in range(channels):
                x[n, c] += step[c] * direction[n, c]
                residual[n, c] -= step[c] * product[n, c]
        energy = _precondition(residual, diagonal, product)
        for c in range(channels):
            step[c] = energy[c] / before[c] if before[c] > 0.0 else 0.0
        for n in range(size):
            for c in range(channels):
                direction[n, c] = product[n, c] + step[c] * direction[n, c]


@kernel
def _precondition(residual: FloatArray, diagonal: FloatArray, scaled: FloatArray) -> FloatArray:
    """Write the residual over the diagonal; return (3,) the products of both."""
    energy = np.zeros(3)
    for n in range(len(residual)):
        for c in range(3):
            scaled[n, c] = residual[n, c] / diagonal[n]
            energy[c] += residual[n, c] * scaled[n, c]
    return energy


@kernel
def _multiply(
    starts: NDArray[np.int32], others: NDArray[np.int32], weights: FloatArray, diagonal: FloatArray,
    direction: FloatArray, product: FloatArray,
) -> FloatArray:  # fmt: skip
    """Write the product of the matrix and a direction; return (3,) the products of both."""
    curvature = np.zeros(3)
    for n in range(len(diagonal)):
        red, green, blue = diagonal[n] * direction[n, 0], diagonal[n] * direction[n, 1], diagonal[n] * direction[n, 2]
        for k in range(starts[n], starts[n + 1]):
            weight, other = weights[k], others[k]
            red -= weight * direction[other, 0]
            green -= weight * direction[other, 1]
            blue -= weight * direction[other, 2]
        product[n, 0], product[n, 1], product[n, 2] = red, green, blue
        curvature[0] += direction[n, 0] * red
        curvature[1] += direction[n, 1] * green
        curvature[2] += direction[n, 2] * blue
    return curvature


def _gaps(
    blend: Blend, sightings: Sightings, gains: FloatArray, mesh: Facets
) -> tuple[IndexArray, IndexArray, FloatArray]:
    """Return (M,) nodes where photos meet, (M,) the heaviest node there, and (M, 3) its photo's color minus the node's.

    Colors are compared on triangles at the vertex with usable views of both photos; pairs without any are omitted.
    """
    others, heads = _seam_pairs(blend, len(mesh.vertices))
    photo_of = np.repeat(np.arange(sightings.photos), np.diff(blend.starts))
    order = np.argsort(photo_of[others], kind="stable")
    starts = np.searchsorted(photo_of[others][order], np.arange(sightings.photos + 1))
    head_photo = np.full(len(mesh.vertices), NONE, np.int64)
    place = np.zeros(len(mesh.vertices), np.int64)
    gaps = np.full((len(others), 3), np.nan)
    for photo in range(sightings.photos):
        rows = order[starts[photo] : starts[photo + 1]]
        at = blend.vertex[others[rows]]
        head_photo[at], place[at] = photo_of[heads[rows]], np.arange(len(rows))
        fan = mesh.faces_at(at)
        near = fan[sightings.is_usable(photo, fan)]
        head, node = head_photo[mesh.faces[near]], place[mesh.faces[near]]
        view = sightings.find(head, np.where(head == NONE, NONE, near[:, None]))
        both = (view != NONE) & (sightings.score[view] > 0)
        own = sightings.colors[sightings.find(photo, near)] / gains[photo]
        difference = sightings.colors[view] / gains[head] - own[:, None]
        count = np.bincount(node[both], minlength=len(rows))
        for channel in range(3):
            total = np.bincount(node[both], difference[..., channel][both], len(rows))
            gaps[rows, channel] = np.divide(total, count, out=np.full(len(rows), np.nan), where=count > 0)
        head_photo[at] = NONE
    known = np.isfinite(gaps[:, 0])
    return others[known], heads[known], gaps[known]


def _seam_pairs(blend: Blend, size: int) -> tuple[IndexArray, IndexArray]:
    """Return all nodes but the heaviest at each vertex, and for each node the heaviest."""
    order = np.lexsort((-blend.weight, blend.vertex))
    heads = np.full(size, -1, np.int64)
    vertices, first = np.unique(blend.vertex[order], return_index=True)
    heads[vertices] = order[first]
    others = np.delete(order, first)
    return others, heads[blend.vertex[others]]


def _ties(blend: Blend, mesh: Facets) -> tuple[IndexArray, IndexArray]:
    """Return pairs of nodes of the same photo at the two ends of an edge."""
    start, end = [np.empty(0, np.int64)], [np.empty(0, np.int64)]
    node = np.full(len(mesh.vertices), -1, np.int64)
    for photo in range(len(blend.starts) - 1):
        part = blend.photo_rows(photo)
        vertices = blend.vertex[part]
        node[vertices] = np.arange(part.start, part.stop)
        ends = node[mesh.edges[mesh.edges_among(vertices)]]
        start.append(ends[:, 0])
        end.append(ends[:, 1])
    return np.concatenate(start), np.concatenate(end)
