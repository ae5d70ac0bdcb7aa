"""Colors and texels of triangles that no photo sees, from the surrounding triangles."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from sfm_app.jit import kernel
from sfm_app.texture.facets import NONE, Facets, IntArray, distinct, sum_at_vertices
from sfm_app.texture.sightings import Sightings
from sfm_app.types.arrays import FloatArray, IndexArray

# Blending near seams: weights of the photos at the vertices, and offsets that remove color differences.
#
# The weight of a photo at a vertex starts as the share of the vertex's triangles that it colors. It is diffused
# over a few rings of vertices, as far as the photo sees them. Where two photos meet at a vertex, their colors
# should be equal: offsets that vary slowly over the chart make them so (Lempitsky & Ivanov 2007; Waechter et al.
# 2014, section 3.2).

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


# Offsets that make colors of photos equal at seams; see `blending`.

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


CELL = 2
"""Side of the square of an unseen triangle, in texels; bilinear interpolation inside it is exact."""
BLOCK = 64
"""Largest number of squares along a side of a block."""
SQUARE_CORNERS = np.array([[0.5, 0.5], [1.5, 0.5], [0.5, 1.5]])
"""Corners of a triangle in its square, on the centers of texels."""
ROUNDING = 5e-3
"""Texels that a corner may be off: single precision on the largest page gives a thousandth. Chosen by hand."""
PREVIOUS_COLOR_WEIGHT = 1e-4
"""Weight of the previous color of an unseen vertex, relative to 1 per neighbor, for parts that no photo sees."""


def vertex_colors(mesh: Facets, seen: NDArray[np.bool_], corner_colors: FloatArray) -> FloatArray:
    """Compute colors of all vertices, diffused from the triangles that photos see to the others.

    Args:
        mesh: the surface; its colors stay in parts that no photo sees.
        seen: (T,) whether a photo sees the triangle.
        corner_colors: (S, 3, 3) RGB at the corners of the seen triangles.

    Returns:
        (V, 3) in 0..255.
    """
    faces, size = mesh.faces[seen], len(mesh.vertices)
    count = sum_at_vertices(np.ones(len(faces)), faces, size)
    sums = [np.bincount(faces.ravel(), corner_colors[..., channel].ravel(), size) for channel in range(3)]
    known = count > 0
    colors = mesh.surface.colors.astype(np.float64)
    colors[known] = np.stack(sums, axis=1)[known] / count[known, None]
    free = np.full(size, -1, np.int64)
    free[~known] = np.arange(size - known.sum())
    if known.all() or not known.any():
        return colors
    ends = free[mesh.edges]
    inner = (ends >= 0).all(axis=1)
    rim = (ends >= 0).any(axis=1) & ~inner
    outside = np.where(ends[rim, 0] < 0, mesh.edges[rim, 0], mesh.edges[rim, 1])
    inside = ends[rim].max(axis=1)
    hold = np.asarray(PREVIOUS_COLOR_WEIGHT + np.bincount(inside, minlength=int((~known).sum())), np.float64)
    right = PREVIOUS_COLOR_WEIGHT * colors[~known]
    for channel in range(3):
        right[:, channel] += np.bincount(inside, colors[outside, channel], len(right))
    spread = solve_ties(ends[inner, 0], ends[inner, 1], np.ones(int(inner.sum())), hold, right)
    colors[~known] = np.clip(spread, 0, 255)
    return colors


def block_sizes(triangles: int) -> NDArray[np.int32]:
    """Return (B, 2) widths and heights in texels of blocks that hold one square per triangle."""
    sizes = []
    for start in range(0, triangles, BLOCK * BLOCK):
        count = min(triangles - start, BLOCK * BLOCK)
        columns = min(BLOCK, int(np.ceil(np.sqrt(count))))
        sizes.append((columns * CELL, -(-count // columns) * CELL))
    return np.array(sizes, np.int32).reshape(-1, 2)


def squares(places: NDArray[np.int32], sizes: NDArray[np.int32], triangles: int) -> NDArray[np.int64]:
    """Return (N, 3) page, x and y of the square of each triangle, row by row through the blocks.

    Args:
        places: (B, 3) page, left and top of each block, in texels.
        sizes: (B, 2) from `block_sizes`.
        triangles: number of triangles.
    """
    found: list[NDArray[np.int64]] = []
    for number, ((page, left, top), (width, _)) in enumerate(zip(places, sizes, strict=True)):
        count = min(triangles - number * BLOCK * BLOCK, BLOCK * BLOCK)
        row, column = np.divmod(np.arange(count), width // CELL)
        found.append(np.column_stack([np.full(count, page), left + CELL * column, top + CELL * row]))
    return np.concatenate(found).astype(np.int64) if found else np.empty((0, 3), np.int64)


def are_squares(corners: FloatArray) -> NDArray[np.bool_]:
    """Return (T,) which triangles are those of squares, by their corners.

    Args:
        corners: (T, 3, 2) texels, off by single precision.
    """
    first = np.floor(corners[:, :1])
    return np.asarray((np.abs(corners - first - SQUARE_CORNERS) < ROUNDING).all(axis=(1, 2)))


def square_texels(corner_colors: FloatArray) -> NDArray[np.uint8]:
    """Return (N, 2, 2, 3) texels whose bilinear interpolation gives colors (N, 3, 3) at the corners.

    The corners lie on texel centers: the first top left, the second top right, the third bottom left.
    """
    a, b, c = (corner_colors[:, k] for k in range(3))
    texels = np.stack([np.stack([a, b], axis=1), np.stack([c, b + c - a], axis=1)], axis=1)
    return np.asarray(np.round(np.clip(texels, 0, 255)), np.uint8)
