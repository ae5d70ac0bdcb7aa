"""The resolution of Poisson reconstruction, and the removal of small connected parts.

SciPy is imported where it is used: a program that only estimates fundamental matrices starts without it.
"""

import numpy as np
from numpy.typing import NDArray

from sfm_app.geometry.triangles import select_faces
from sfm_app.types import Surface

MIN_POINTS = 1.4
"""Least mean number of points in an occupied cell of Poisson's finest grid."""
MARGIN = 1.1
"""Width of Poisson's cube in extents of the points."""


def octree_depth(points: NDArray[np.float64], most: int, most_cells: float = np.inf) -> int:
    """Return the greatest depth at which the occupied cells of Poisson's octree hold enough points.

    Finer cells, most with at most one point, would only model noise, with four times the triangles per level. Nor
    are there more than asked for.

    Args:
        points: (N, 3).
        most: largest depth, >= 1.
        most_cells: most occupied cells; each gives about two and a half triangles.
    """
    extent = MARGIN * np.ptp(points, axis=0).max(initial=0.0) if len(points) else 0.0
    if extent == 0.0:
        return 1
    cells = np.floor((points - points.min(axis=0)) * (2**most / extent)).astype(np.int64)
    for depth in range(most, 1, -1):
        keys = np.sort((cells[:, 0] << 2 * depth) + (cells[:, 1] << depth) + cells[:, 2])
        occupied = 1 + np.count_nonzero(keys[1:] != keys[:-1])
        if len(points) >= MIN_POINTS * occupied and occupied <= most_cells:
            return depth
        cells >>= 1
    return 1


def drop_islands(surface: Surface, min_share: float) -> Surface:
    """Drop connected parts that have too few triangles.

    Args:
        surface: any.
        min_share: smallest share of all triangles that is kept, in [0, 1].
    """
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    if not len(surface.faces):
        return surface
    a, b, c = surface.faces.T
    rows, cols = np.concatenate([a, b]), np.concatenate([b, c])
    size = len(surface.vertices)
    _, part = connected_components(coo_array((np.ones(len(rows), bool), (rows, cols)), (size, size)), directed=False)
    part_of_face = part[a]
    triangles = np.bincount(part_of_face)
    return select_faces(surface, triangles[part_of_face] >= min_share * len(surface.faces))
