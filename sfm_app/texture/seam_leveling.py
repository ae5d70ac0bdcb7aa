"""Offsets that make colors of photos equal at seams; see `blending`."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from sfm_app.jit import kernel
from sfm_app.texture.appearance.sightings import Sightings
from sfm_app.texture.blending import Blend
from sfm_app.texture.facets import NONE, Facets

FloatArray = NDArray[np.float64]
IndexArray = NDArray[np.int64]

STIFFNESS = 4.0
"""Weight of differences of offsets along a chart, relative to 1 for differences at seams."""
PRIOR_WEIGHT = 1e-3
"""Weight of the prior that offsets are zero."""
STEPS = 100
RESIDUAL_TOLERANCE = 1e-2
"""Norm of the preconditioned residual at which the solver stops, relative to its initial value."""


def level_seams(blend: Blend, seen: Sightings, gains: FloatArray, mesh: Facets) -> Blend:
    """Estimate the offsets of a blend by least squares.

    Args:
        blend: weights of the photos at the vertices.
        seen: which photos see which triangles, in which colors; not used where the worth is negative.
        gains: (P, 3) of the photos.
        mesh: the surface.
    """
    first, second, gap = _gaps(blend, seen, gains, mesh)
    start, end = _ties(blend, mesh)
    right = np.zeros((len(blend.vertex), 3))
    for channel in range(3):
        right[:, channel] += np.bincount(first, gap[:, channel], len(right))
        right[:, channel] -= np.bincount(second, gap[:, channel], len(right))
    weights = np.concatenate([np.ones(len(first)), np.full(len(start), STIFFNESS)])
    offsets = solve_ties(np.concatenate([first, start]), np.concatenate([second, end]), weights, PRIOR_WEIGHT, right)
    return replace(blend, offset=offsets.astype(np.float32))


def solve_ties(
    one: NDArray[np.int64], other: NDArray[np.int64], weights: FloatArray, hold: float | FloatArray, right: FloatArray
) -> FloatArray:
    """Return (N, 3) x that solves (graph Laplacian + hold) x = right, by conjugate gradients.

    Args:
        one: (E,) node at one end of each edge of the graph.
        other: (E,) node at the other end.
        weights: (E,) of the edges.
        hold: added to the diagonal, > 0 somewhere in each connected part; a number or (N,).
        right: (N, 3) right-hand sides.
    """
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
    """Solve (diagonal - weights) x = right by conjugate gradients from x = 0, scaled by the diagonal."""
    size, channels = len(right), 3
    residual, way, moved = right.copy(), np.empty_like(right), np.empty_like(right)
    energy, enough, step = np.zeros(channels), np.zeros(channels), np.zeros(channels)
    for n in range(size):
        for c in range(channels):
            way[n, c] = residual[n, c] / diagonal[n]
            energy[c] += residual[n, c] * way[n, c]
    for c in range(channels):  # assigning rows compiles for a second
        enough[c] = RESIDUAL_TOLERANCE * RESIDUAL_TOLERANCE * energy[c]
    for _ in range(STEPS):
        if energy[0] <= enough[0] and energy[1] <= enough[1] and energy[2] <= enough[2]:
            break
        along = np.zeros(channels)
        for n in range(size):
            red, green, blue = diagonal[n] * way[n, 0], diagonal[n] * way[n, 1], diagonal[n] * way[n, 2]
            for k in range(starts[n], starts[n + 1]):
                weight, other = weights[k], others[k]
                red -= weight * way[other, 0]
                green -= weight * way[other, 1]
                blue -= weight * way[other, 2]
            moved[n, 0], moved[n, 1], moved[n, 2] = red, green, blue
            along[0] += way[n, 0] * red
            along[1] += way[n, 1] * green
            along[2] += way[n, 2] * blue
        before = energy.copy()
        for c in range(channels):
            step[c] = energy[c] / along[c] if along[c] > 0.0 else 0.0
            energy[c] = 0.0
        for n in range(size):
            for c in range(channels):
                x[n, c] += step[c] * way[n, c]
                residual[n, c] -= step[c] * moved[n, c]
                moved[n, c] = residual[n, c] / diagonal[n]
                energy[c] += residual[n, c] * moved[n, c]
        for c in range(channels):
            step[c] = energy[c] / before[c] if before[c] > 0.0 else 0.0
        for n in range(size):
            for c in range(channels):
                way[n, c] = moved[n, c] + step[c] * way[n, c]


def _gaps(
    blend: Blend, seen: Sightings, gains: FloatArray, mesh: Facets
) -> tuple[NDArray[np.int64], NDArray[np.int64], FloatArray]:
    """Find nodes where two photos meet at a vertex, and their color differences.

    Colors are compared on the triangles at the vertex that both photos may be used for; pairs without any are left out.

    Returns:
        (M,) node, (M,) node of the largest weight at its vertex, and (M, 3) color of the latter minus the former.
    """
    others, heads = _seam_pairs(blend, len(mesh.vertices))
    photo_of = np.repeat(np.arange(seen.photos), np.diff(blend.starts))
    order = np.argsort(photo_of[others], kind="stable")
    starts = np.searchsorted(photo_of[others][order], np.arange(seen.photos + 1))
    head_photo = np.full(len(mesh.vertices), NONE, np.int64)
    place = np.zeros(len(mesh.vertices), np.int64)
    gaps = np.full((len(others), 3), np.nan)
    for photo in range(seen.photos):
        rows = order[starts[photo] : starts[photo + 1]]
        at = blend.vertex[others[rows]]
        head_photo[at], place[at] = photo_of[heads[rows]], np.arange(len(rows))
        around = mesh.faces_at(at)
        near = around[seen.is_usable(photo, around)]
        corners = head_photo[mesh.faces[near]], place[mesh.faces[near]]
        gaps[rows] = _photo_gaps(photo, near, corners, seen, gains, len(rows))
        head_photo[at] = NONE
    known = np.isfinite(gaps[:, 0])
    return others[known], heads[known], gaps[known]


def _photo_gaps(
    photo: int, near: IndexArray, corners: tuple[IndexArray, IndexArray], seen: Sightings, gains: FloatArray, size: int
) -> FloatArray:
    """Return (size, 3) mean color of other photos at vertices minus that of one photo; NaN where unknown.

    Args:
        photo: number of the one photo.
        near: (M,) triangles that it may be used for.
        corners: (M, 3) the other photo at each corner, -1 for none; and (M, 3) number of the vertex there.
        seen: views of triangles in photos.
        gains: (P, 3) of the photos.
        size: number of vertices.
    """
    head, place = corners
    row = seen.find(head, np.where(head == NONE, NONE, near[:, None]))
    both = (row != NONE) & (seen.worth[row] > 0)
    own = seen.colors[seen.find(photo, near)] / gains[photo]
    difference = seen.colors[row] / gains[head] - own[:, None]
    count = np.bincount(place[both], minlength=size)
    found = np.full((size, 3), np.nan)
    for channel in range(3):
        total = np.bincount(place[both], difference[..., channel][both], size)
        np.divide(total, count, out=found[:, channel], where=count > 0)
    return found


def _seam_pairs(blend: Blend, size: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return all nodes except the one of the largest weight at each vertex, and for each the one it is paired with."""
    order = np.lexsort((-blend.weight, blend.vertex))
    heads = np.full(size, -1, np.int64)
    ranked = blend.vertex[order]
    first = np.concatenate([[True], ranked[1:] != ranked[:-1]]) if len(ranked) else np.empty(0, bool)
    heads[ranked[first]] = order[first]
    others = order[~first]
    return others, heads[blend.vertex[others]]


def _ties(blend: Blend, mesh: Facets) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
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
