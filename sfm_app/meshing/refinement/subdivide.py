"""Divide triangles that are too large for the detail that photos show."""

import numpy as np
from numpy.typing import NDArray

from sfm_app.geometry.culling import morton_order
from sfm_app.geometry.triangles import unique_edges
from sfm_app.jit import kernel
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
    middle = np.full(len(edges), -1)
    count = _number_long(edges, surface.vertices, longest, middle)
    one, other = edges[middle >= 0].T
    colors = (surface.colors[one].astype(np.uint16) + surface.colors[other]) // 2
    return Surface(
        np.concatenate([surface.vertices, (surface.vertices[one] + surface.vertices[other]) / 2.0]),
        _divide(surface.faces, middle[edge_of]) if count else surface.faces,
        np.concatenate([surface.colors, colors.astype(np.uint8)]),
    )


@kernel
def _number_long(edges: IndexArray, vertices: FloatArray, longest: FloatArray, middle: IndexArray) -> int:
    """Fill in the numbers of the new vertices in the middle of edges that are too long; return how many there are."""
    count = 0
    for k in range(len(edges)):
        a, b = edges[k, 0], edges[k, 1]
        x, y, z = vertices[b, 0] - vertices[a, 0], vertices[b, 1] - vertices[a, 1], vertices[b, 2] - vertices[a, 2]
        if np.sqrt(x * x + y * y + z * z) > min(longest[a], longest[b]):
            middle[k] = len(vertices) + count
            count += 1
    return count


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
    count = np.sum([side >= 0 for side in middle.T], axis=0)
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
