"""The removal of small connected parts.

SciPy is imported where it is used: a program that only estimates fundamental matrices starts without it.
"""

import numpy as np

from sfm_app.geometry.triangles import select_faces
from sfm_app.types import Surface


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
