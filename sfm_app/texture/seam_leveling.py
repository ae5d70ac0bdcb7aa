"""Offsets that make colors of photos equal at seams; see `blending`."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from sfm_app.texture.blending import Blend
from sfm_app.texture.facets import Facets, sum_at_vertices

FloatArray = NDArray[np.float64]

STIFFNESS = 4.0
"""Weight of differences of offsets along a chart, relative to 1 for differences at seams."""
PRIOR_WEIGHT = 1e-3
"""Weight of the prior that offsets are zero."""
STEPS = 100
RESIDUAL_TOLERANCE = 1e-2
"""Norm of the preconditioned residual at which the solver stops, relative to its initial value."""


def level_seams(
    blend: Blend, colors: NDArray[np.uint8], gains: FloatArray, usable: NDArray[np.bool_], mesh: Facets
) -> Blend:
    """Estimate the offsets of a blend by least squares.

    Args:
        blend: weights of the photos at the vertices.
        colors: (P, T, 3) RGB of the triangles in the photos.
        gains: (P, 3) of the photos.
        usable: (P, T) whether a photo may be used for a triangle.
        mesh: the surface.
    """
    first, second, gap = _gaps(blend, colors, gains, usable, mesh)
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
    """Return (N, C) x that solves (graph Laplacian + hold) x = right, by conjugate gradients.

    Args:
        one: (E,) node at one end of each edge of the graph.
        other: (E,) node at the other end.
        weights: (E,) of the edges.
        hold: added to the diagonal, > 0 somewhere in each connected part; a number or (N,).
        right: (N, C) right-hand sides.
    """
    from scipy.sparse import coo_matrix, diags

    size = len(right)
    diagonal = np.bincount(one, weights, size) + np.bincount(other, weights, size) + hold
    rows, columns = np.concatenate([one, other]), np.concatenate([other, one])
    ties = coo_matrix((-np.concatenate([weights, weights]), (rows, columns)), shape=(size, size)).tocsr()
    matrix = (ties + diags(diagonal)).tocsr()
    x = np.zeros_like(right)
    residual = right.copy()
    scaled = residual / diagonal[:, None]
    way, energy = scaled.copy(), np.einsum("nc,nc->c", residual, scaled)
    enough = RESIDUAL_TOLERANCE**2 * energy
    for _ in range(STEPS):
        if np.all(energy <= enough):
            break
        moved = matrix @ way
        step = _ratio(energy, np.einsum("nc,nc->c", way, moved))
        x += step * way
        residual -= step * moved
        scaled = residual / diagonal[:, None]
        before, energy = energy, np.einsum("nc,nc->c", residual, scaled)
        way = scaled + _ratio(energy, before) * way
    return x


def _ratio(above: FloatArray, below: FloatArray) -> FloatArray:
    return np.divide(above, below, out=np.zeros_like(above), where=below > 0)


def _gaps(
    blend: Blend, colors: NDArray[np.uint8], gains: FloatArray, usable: NDArray[np.bool_], mesh: Facets
) -> tuple[NDArray[np.int64], NDArray[np.int64], FloatArray]:
    """Find nodes where two photos meet at a vertex, and their color differences.

    Colors are compared on the triangles at the vertex that both photos may be used for; pairs without any are left out.

    Returns:
        (M,) node, (M,) node of the largest weight at its vertex, and (M, 3) color of the latter minus the former.
    """
    others, heads = _seam_pairs(blend, len(mesh.vertices))
    photo_of = np.repeat(np.arange(len(usable)), np.diff(blend.starts))
    gaps = np.full((len(others), 3), np.nan)
    for photo in range(len(usable)):
        rows = np.flatnonzero(photo_of[others] == photo)
        head_photo = np.full(len(mesh.vertices), -1, np.int64)
        head_photo[blend.vertex[others[rows]]] = photo_of[heads[rows]]
        near = np.flatnonzero(usable[photo] & (head_photo[mesh.faces] >= 0).any(axis=1))
        corners = mesh.faces[near]
        head = head_photo[corners]
        both = (head >= 0) & usable[head, near[:, None]]
        difference = colors[head, near[:, None]] / gains[head] - (colors[photo, near] / gains[photo])[:, None]
        at = blend.vertex[others[rows]]
        count = sum_at_vertices(both.astype(np.float64), corners, len(mesh.vertices))[at]
        for channel in range(3):
            total = sum_at_vertices(np.where(both, difference[..., channel], 0.0), corners, len(mesh.vertices))[at]
            gaps[rows, channel] = np.divide(total, count, out=np.full(len(rows), np.nan), where=count > 0)
    known = np.isfinite(gaps[:, 0])
    return others[known], heads[known], gaps[known]


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
        node[blend.vertex[part]] = np.arange(part.start, part.stop)
        ends = node[mesh.edges]
        both = (ends >= 0).all(axis=1)
        start.append(ends[both, 0])
        end.append(ends[both, 1])
        node[blend.vertex[part]] = -1
    return np.concatenate(start), np.concatenate(end)
