"""Cutting away what a closed surface invents where nothing was measured.

SciPy is imported where it is used: a program that only estimates fundamental matrices starts without it.
"""

import numpy as np
from numpy.typing import NDArray

from sfm_app.geometry.triangles import vertex_normals
from sfm_app.types import Surface

NEIGHBOURS = 6
REACH = 6.0
"""How far, in spacings of the points, the surface may go beyond them: it closes small holes but spans no gaps."""
MIN_CELL = 0.8
"""Least width of Poisson's cells in spacings of the points."""
MIN_COSINE = 0.1
"""Least cosine between the surface and the measured point nearest to it."""
MAX_SPREAD = 4.0
"""Points wider apart than this many median spacings are strays and do not carry more surface for it."""


def octree_depth(points: NDArray[np.float64], most: int) -> int:
    """Greatest depth, at most `most`, whose finest cell in Poisson's octree still holds a point or so of (N, 3).

    Finer cells would only model the noise, at four times the triangles per level.
    """
    if len(points) <= NEIGHBOURS:
        return most
    cell = MIN_CELL * np.median(_spacing(points))
    return int(np.clip(np.floor(np.log2(np.ptp(points, axis=0).max() / cell)), 1, most))


def trim_unsupported(surface: Surface, points: NDArray[np.float64], normals: NDArray[np.float64]) -> Surface:
    """Keep the triangles whose corners all lie near measured points and face the way that those do.

    Near is relative to how dense the points are there, so that the background, seen with fewer pixels, is kept too. The
    normals tell the measured side of a thing from the back that Poisson bends around its rim.

    Args:
        surface: as Poisson gives it.
        points: (N, 3) measured points.
        normals: (N, 3) their unit normals.
    """
    from scipy.spatial import cKDTree

    if len(points) <= NEIGHBOURS or not len(surface.faces):
        return select_faces(surface, np.zeros(len(surface.faces), bool))
    spacing = _spacing(points)
    spacing = np.minimum(spacing, MAX_SPREAD * np.median(spacing))
    distance, nearest = cKDTree(points).query(surface.vertices)
    cosine = np.sum(vertex_normals(surface.vertices, surface.faces) * normals[nearest], axis=1)
    supported = (distance <= REACH * spacing[nearest]) & (cosine >= MIN_COSINE)
    return select_faces(surface, supported[surface.faces].all(axis=1))


def _spacing(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Per point the distance at which a sheet of points has `NEIGHBOURS` others, as the width of one point's share."""
    from scipy.spatial import cKDTree

    distance = np.asarray(cKDTree(points).query(points, k=[NEIGHBOURS + 1])[0])[:, 0]
    return np.asarray(distance * np.sqrt(np.pi / (NEIGHBOURS + 1)))


def drop_islands(surface: Surface, min_share: float) -> Surface:
    """Drop connected parts that have less than a share in [0, 1] of all triangles."""
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


def select_faces(surface: Surface, keep: NDArray[np.bool_]) -> Surface:
    """The marked triangles (T,) with the vertices that they use, in the old order."""
    used, faces = np.unique(surface.faces[keep], return_inverse=True)
    return Surface(surface.vertices[used], faces.reshape(-1, 3).astype(np.int64), surface.colors[used])
