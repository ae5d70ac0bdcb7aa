"""Normal maps of all pages, baked from the normals of a fine surface."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from sfm_app.geometry.triangles import corner_tangents, unit_normals
from sfm_app.jit import kernel
from sfm_app.tasks import ParallelMap
from sfm_app.texture.charts import are_squares
from sfm_app.texture.pages import owners, set_shares
from sfm_app.texture.sightings import NONE, IntArray
from sfm_app.types import Model, Surface, Texture
from sfm_app.types.arrays import FloatArray

SHRINK = 2
"""Texels of color, along a side, per texel of normals. With 1, 2 and 4, shading on fountain-P11 is 0.7, 1.1 and 2.2
degrees off on average (benchmarks/surface/normal_map.py); 1 takes almost three times the bytes of 2."""
BAND = 2**18
"""Texels baked at once, so that memory does not grow with the page. Chosen by hand: 40 MB."""

FindNormals = Callable[[NDArray[np.float32], NDArray[np.float32]], NDArray[np.float32]]
"""Returns the normals (N, 3) of the fine surface near points (N, 3), on the side of directions (N, 3); 0 for none."""

# Texels of a normal map: the tangent frames at their points, and normals in these frames.
# Tangent, bitangent and normal are interpolated, each by itself, and then normalized, as three.js and Khronos'
# viewer do. MikkTSpace normalizes none of them, and makes the bitangent from the interpolated two.


def interpolate_frames(
    owner: IntArray, top: int, corners: FloatArray, points: FloatArray, frames: FloatArray
) -> tuple[NDArray[np.float32], FloatArray]:
    """Return points (N, 3) and frames (N, 3, 3), of unit rows, of all texels with an owner, row by row.

    `owner` (h, W) is the triangle of each texel in rows of a page from `top` on, -1 for none. The corners (T, 3, 2) are
    in texels, the points (T, 3, 3) in the scene; the frames (T, 3, 3, 3) come from `corner_frames`.
    """
    face, parts = owner[owner != NONE], np.empty((np.count_nonzero(owner != NONE), 3))
    _set_all_shares(owner, top, corners, parts)
    first, second, third = parts.T[:, :, None]
    texel_points = first * points[face, 0] + second * points[face, 1] + third * points[face, 2]
    first, second, third = first[..., None], second[..., None], third[..., None]
    mixed = first * frames[face, 0] + second * frames[face, 1] + third * frames[face, 2]
    length = np.linalg.norm(mixed, axis=2, keepdims=True)
    return texel_points.astype(np.float32), mixed / np.where(length > 0.0, length, 1.0)


@kernel
def _set_all_shares(owner: IntArray, top: int, corners: FloatArray, parts: FloatArray) -> None:
    """Write the barycentric coordinates (N, 3) of all texels with an owner, row by row."""
    n = 0
    for y in range(owner.shape[0]):
        for x in range(owner.shape[1]):
            if owner[y, x] != NONE:
                set_shares(corners[owner[y, x]], x + 0.5, top + y + 0.5, parts[n])
                n += 1


def encode(owner: IntArray, frames: FloatArray, normals: NDArray[np.float32]) -> tuple[NDArray[np.uint8], int]:
    """Return the texels (h, w, 3) of rows of a normal map, and how many have a fine normal (N, 3), not 0.

    Flat frames, and normals behind the surface, give the normal of the surface.
    """
    t, b, n = frames[:, 0], frames[:, 1], frames[:, 2]
    # Cramer's rule, since interpolated frames are not at right angles
    volumes = ((t, b, n), (normals, b, n), (t, normals, n), (t, b, normals))
    whole, *parts = ((one * np.cross(two, three)).sum(axis=1) for one, two, three in volumes)
    local = np.stack(parts, axis=1) / np.where(np.abs(whole) < 1e-6, np.inf, whole)[:, None]
    own = local[:, 2] > 0.0
    local[~own] = 0.0, 0.0, 1.0
    directions = np.zeros((*owner.shape, 3)) + np.array([0.0, 0.0, 1.0])
    directions[owner != NONE] = local / np.linalg.norm(local, axis=1, keepdims=True)
    return np.floor(128.0 + 127.5 * directions).astype(np.uint8), int(np.count_nonzero(own))


def bake_normals(model: Model, find: FindNormals, spread: ParallelMap, band: int = BAND) -> tuple[Model, float]:
    """Return a model with normal maps, `band` texels at once, and the share of chart texels with a fine normal."""
    texture = model.texture
    if texture is None:
        return model, 0.0
    points, frames = model.surface.vertices[model.surface.faces], corner_frames(model.surface, texture)
    maps, own, whole = list[NDArray[np.uint8]](), 0, 0
    for number in range(len(texture.pages)):
        corners, owner = _page_owners(texture, number)
        work = partial(_bake_rows, owner=owner, corners=corners, points=points, frames=frames, find=find)
        rows = max(1, band // owner.shape[1])
        bands = [slice(top, top + rows) for top in range(0, len(owner), rows)]
        baked = spread(work, bands, f"baking normals, page {number + 1} of {len(texture.pages)}")
        maps.append(np.concatenate([texels for texels, _ in baked]))
        own, whole = own + sum(count for _, count in baked), whole + int(np.count_nonzero(owner >= 0))
    return replace(model, texture=replace(texture, normal_maps=tuple(maps))), own / max(whole, 1)


def corner_frames(surface: Surface, texture: Texture) -> FloatArray:
    """Return (T, 3, 3, 3) tangent, bitangent and normal, in this order, at each corner of each triangle."""
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


def _bake_rows(
    band: slice, owner: IntArray, corners: FloatArray, points: FloatArray, frames: FloatArray, find: FindNormals
) -> tuple[NDArray[np.uint8], int]:
    rows = owner[band]
    texel_points, texel_frames = interpolate_frames(rows, band.start, corners, points, frames)
    return encode(rows, texel_frames, find(texel_points, texel_frames[:, 2].astype(np.float32)))
