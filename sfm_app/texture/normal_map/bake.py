"""Normal maps of all pages, baked from the normals of a fine surface."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from sfm_app.geometry.relief.tangents import corner_tangents
from sfm_app.geometry.triangles import unit_normals
from sfm_app.texture.facets import IntArray
from sfm_app.texture.normal_map.texels import encode, texel_frames
from sfm_app.texture.page_painting import ParallelMap
from sfm_app.texture.painting import owners
from sfm_app.texture.unseen_faces import are_squares
from sfm_app.types import Model, Surface, Texture

FloatArray = NDArray[np.float64]
FindNormals = Callable[[NDArray[np.float32], NDArray[np.float32]], NDArray[np.float32]]
"""Gives the normals (N, 3) of the fine surface near points (N, 3), on the side of directions (N, 3); 0 for none."""

SHRINK = 2
"""Texels of color, along a side, for each one of normals. Chosen on fountain-P11 (benchmarks/surface/normal_map.py):
without loss in the file, shading is 1.1 degrees off on average; with 1 it is 0.7, at almost three times the bytes, and
with 4 it is 2.2."""
BAND = 2**18
"""Texels that are baked at once, so that memory does not grow with the page. Chosen by hand: 40 MB."""


def bake_normals(model: Model, find: FindNormals, spread: ParallelMap) -> tuple[Model, float]:
    """Return a model with normal maps, and the share of the texels of its charts that the fine surface determines.

    Where it does not, and on triangles that no photo sees, the normals of the light surface stay.

    Args:
        model: the light surface with its texture.
        find: asks the fine surface.
        spread: applies a function to all parts of a page, possibly in parallel.
    """
    texture = model.texture
    if texture is None:
        return model, 0.0
    points, frames = model.surface.vertices[model.surface.faces], corner_frames(model.surface, texture)
    maps, own, whole = list[NDArray[np.uint8]](), 0, 0
    for number in range(len(texture.pages)):
        corners, owner = _page_owners(texture, number)
        work = partial(_bake_rows, owner=owner, corners=corners, points=points, frames=frames, find=find)
        found = spread(work, _bands(owner), f"baking normals, page {number + 1} of {len(texture.pages)}")
        maps.append(np.concatenate([texels for texels, _ in found]))
        own, whole = own + sum(count for _, count in found), whole + int(np.count_nonzero(owner >= 0))
    return replace(model, texture=replace(texture, normal_maps=tuple(maps))), own / max(whole, 1)


def corner_frames(surface: Surface, texture: Texture) -> FloatArray:
    """Return (T, 3, 3, 3) tangent, bitangent and normal, in this order, at each corner of each triangle.

    Args:
        surface: the triangles.
        texture: where they lie on pages.
    """
    normals = unit_normals(surface)
    tangents = corner_tangents(surface.vertices, normals, surface.faces, texture.uv, texture.page).astype(np.float64)
    along, up = tangents[..., :3], normals[surface.faces]
    return np.stack([along, tangents[..., 3:] * np.cross(up, along), up], axis=2)


def _page_owners(texture: Texture, number: int) -> tuple[FloatArray, IntArray]:
    """Return (T, 3, 2) corners in texels of a normal map, and (H, W) the triangle of each texel, -1 for none."""
    height, width = texture.pages[number].shape[:2]
    own = np.flatnonzero(texture.page == number)
    drawn = own[~are_squares(texture.uv[own].astype(np.float64) * (width, height))]
    size = -(-width // SHRINK), -(-height // SHRINK)
    corners = texture.uv.astype(np.float64) * size
    return corners, owners(size, drawn, corners)


def _bands(owner: IntArray) -> list[slice]:
    rows = max(1, BAND // owner.shape[1])
    return [slice(top, top + rows) for top in range(0, len(owner), rows)]


def _bake_rows(
    band: slice, owner: IntArray, corners: FloatArray, points: FloatArray, frames: FloatArray, find: FindNormals
) -> tuple[NDArray[np.uint8], int]:
    rows = owner[band]
    where, here = texel_frames(rows, band.start, corners, points, frames)
    return encode(rows, here, find(where, here[:, 2].astype(np.float32)))
