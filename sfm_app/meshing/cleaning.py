"""Clean meshes: no islands, doubtful parts, ragged borders, or edges of more than two triangles.

SciPy is imported where it is used: a program that only estimates fundamental matrices starts without it.
"""

import numpy as np
from numpy.typing import NDArray

from sfm_app.geometry.triangles import areas, bucket_order, select_faces, split_fans, unique_edges
from sfm_app.types import Surface
from sfm_app.types.arrays import FloatArray, IndexArray

Edges = tuple[IndexArray, IndexArray]
"""The result of `unique_edges`."""

MIN_HEIGHT = 1e-7
"""A triangle is degenerate below this height, as a share of the surface's size. By definition: single precision."""


def drop_islands(surface: Surface, min_share: float) -> Surface:
    """Drop connected parts with less than `min_share` of all triangles, in [0, 1]."""
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


def make_manifold(surface: Surface) -> Surface:
    """Return the surface as an oriented manifold: at most two triangles at an edge, one fan at a vertex.

    Degenerate, non-finite and duplicate triangles are removed. Where more than two triangles share an edge, or two run
    along it in the same direction, the smallest are removed. Vertices where fans only touch are split.
    """
    surface = select_faces(surface, _proper_faces(surface))
    while len(surface.faces):
        bad = _excess_faces(surface)
        if not bad.any():
            break
        surface = select_faces(surface, ~bad)
    return split_fans(surface)


def _proper_faces(surface: Surface) -> NDArray[np.bool_]:
    """Mark triangles that are finite and not degenerate, each set of corners once, (T,)."""
    corners = surface.vertices[surface.faces]
    sides = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
    area = areas(surface.vertices, surface.faces)
    finite = np.isfinite(area)
    size = np.ptp(surface.vertices[np.isfinite(surface.vertices).all(axis=1)], axis=0).max(initial=0.0)
    ranked, order = np.sort(surface.faces, axis=1), np.arange(len(surface.faces))
    for corner in (2, 1, 0):
        order = order[bucket_order(ranked[order, corner], len(surface.vertices))]
    proper = np.ones(len(surface.faces), bool)
    proper[order[1:]] = (ranked[order[1:]] != ranked[order[:-1]]).any(axis=1)
    return np.asarray(proper & finite & (2.0 * area > MIN_HEIGHT * size * sides))


def _excess_faces(surface: Surface) -> NDArray[np.bool_]:
    """Mark the smallest triangle at every edge with too many triangles or two in the same direction, (T,)."""
    edges, edge_of = unique_edges(surface.faces)
    forward = surface.faces < np.roll(surface.faces, -1, axis=1)
    uses = np.stack([np.bincount(edge_of[same], minlength=len(edges)) for same in (forward, ~forward)])
    wrong = np.asarray((uses > 1).any(axis=0))
    bad = np.zeros(len(surface.faces), bool)
    if wrong.any():
        area = areas(surface.vertices, surface.faces)
        face, side = np.nonzero(wrong[edge_of])
        order = np.lexsort((face, area[face], edge_of[face, side]))
        at = edge_of[face, side][order]
        bad[face[order][np.diff(at, prepend=-1) > 0]] = True
    return bad


def cut(surface: Surface, support: FloatArray, known: Edges | None = None) -> Surface:
    """Return the part of a surface where the support (V,), linear along the edges, is positive; split its border."""
    edges, edge_of = known or unique_edges(surface.faces)
    support = np.where(support == 0, -1e-9, support)
    a, b = support[edges].T
    crossed = (a > 0) != (b > 0)
    share = np.divide(a, a - b, out=np.zeros_like(a), where=crossed)[crossed, None]
    first, second = edges[crossed].T
    vertices = surface.vertices[first] * (1 - share) + surface.vertices[second] * share
    colors = surface.colors[first] * (1 - share) + surface.colors[second] * share
    new = np.full(len(edges), -1)
    new[crossed] = len(surface.vertices) + np.arange(len(vertices))
    faces = _split(surface.faces, new[edge_of], support[surface.faces] > 0)
    all_colors = np.concatenate([surface.colors, np.rint(colors).astype(np.uint8)])
    extended = Surface(np.concatenate([surface.vertices, vertices]), faces, all_colors)
    return select_faces(extended, np.ones(len(faces), bool))


def _split(faces: IndexArray, middle: IndexArray, inside: NDArray[np.bool_]) -> IndexArray:
    """Return triangles inside, and the inner parts of others; `middle` (T, 3) has the new vertices on ab, bc, ca."""
    parts = [faces[inside.all(axis=1)]]
    count = inside.sum(axis=1)
    for corner in range(3):
        a, b, c = corner, (corner + 1) % 3, (corner + 2) % 3
        one = (count == 1) & inside[:, a]
        parts.append(np.stack([faces[one, a], middle[one, a], middle[one, c]], axis=1))
        two = (count == 2) & ~inside[:, a]
        parts.append(np.stack([middle[two, a], faces[two, b], faces[two, c]], axis=1))
        parts.append(np.stack([middle[two, a], faces[two, c], middle[two, c]], axis=1))
    return np.concatenate(parts)
