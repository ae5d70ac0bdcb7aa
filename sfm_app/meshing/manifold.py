"""Repair of a mesh: no degenerate or duplicate triangles, an oriented manifold."""

import numpy as np
from numpy.typing import NDArray

from sfm_app.geometry.triangles import areas, bucket_order, select_faces, split_fans, unique_edges
from sfm_app.types import Surface

MIN_HEIGHT = 1e-7
"""A triangle is degenerate below this height, as a share of the surface's size; single precision resolves no less."""


def make_manifold(surface: Surface) -> Surface:
    """Return the surface as an oriented manifold.

    Every edge then has one triangle, or two that run along it in opposite directions; those at a vertex form one fan.

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
    uses = np.stack([np.bincount(edge_of[way], minlength=len(edges)) for way in (forward, ~forward)])
    wrong = np.asarray((uses > 1).any(axis=0))
    bad = np.zeros(len(surface.faces), bool)
    if wrong.any():
        area = areas(surface.vertices, surface.faces)
        face, side = np.nonzero(wrong[edge_of])
        order = np.lexsort((face, area[face], edge_of[face, side]))
        at = edge_of[face, side][order]
        bad[face[order][np.diff(at, prepend=-1) > 0]] = True
    return bad
