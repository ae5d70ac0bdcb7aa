"""Colors and texels of triangles that no photo sees, from the surrounding triangles."""

import numpy as np
from numpy.typing import NDArray

from sfm_app.texture.facets import Facets, sum_at_vertices
from sfm_app.texture.seam_leveling import solve_ties

FloatArray = NDArray[np.float64]

CELL = 2
"""Side of the square of an unseen triangle, in texels; bilinear interpolation inside it is exact."""
BLOCK = 64
"""Largest number of squares along a side of a block."""
SQUARE_CORNERS = np.array([[0.5, 0.5], [1.5, 0.5], [0.5, 1.5]])
"""Corners of a triangle in its square, on the centers of texels."""
ROUNDING = 5e-3
"""Texels that a corner may be off: single precision on the largest page gives a thousandth. Chosen by hand."""
PRIOR_WEIGHT = 1e-4
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
    hold = np.asarray(PRIOR_WEIGHT + np.bincount(inside, minlength=int((~known).sum())), np.float64)
    right = PRIOR_WEIGHT * colors[~known]
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
