"""Normal maps of all pages, baked from the normals of a fine surface."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from sfm_app.geometry.triangles import corner_tangents, unit_normals
from sfm_app.jit import kernel
from sfm_app.texture.facets import NONE, IntArray
from sfm_app.texture.pages import ParallelMap, owners, set_shares
from sfm_app.texture.seams import are_squares
from sfm_app.types import Model, Surface, Texture
from sfm_app.types.arrays import FloatArray

# Texels of a normal map: the frames along the texture at their points, and normals in these frames.
#
# Tangent, bitangent and normal are interpolated, each by itself, and then normalized, as three.js and Khronos'
# viewer do. MikkTSpace normalizes none of them, and makes the bitangent from the interpolated two.

FLAT = 1e-6
"""Volume that three unit vectors span below which they give no frame. Chosen by hand."""


@kernel
def texel_frames(
    owner: IntArray, top: int, corners: FloatArray, points: FloatArray, frames: FloatArray
) -> tuple[NDArray[np.float32], FloatArray]:
    """Return points (N, 3) and frames (N, 3, 3) of all texels with an owner, row by row; the rows of a frame are units.

    Args:
        owner: (h, W) triangle of each texel in some rows of a page, -1 for none.
        top: the first of these rows.
        corners, points: (T, 3, 2) texels, and (T, 3, 3) where they are in the scene.
        frames: (T, 3, 3, 3) from `corner_frames`.
    """
    count, n, part = np.count_nonzero(owner != NONE), 0, np.empty(3)
    where, found = np.empty((count, 3), np.float32), np.empty((count, 3, 3))
    for y in range(owner.shape[0]):
        for x in range(owner.shape[1]):
            f = owner[y, x]
            if f == NONE:
                continue
            set_shares(corners[f], x + 0.5, top + y + 0.5, part)
            for axis in range(3):
                where[n, axis] = _mix(part, points[f, :, axis])
            _set_frame(part, frames[f], found[n])
            n += 1
    return where, found


@kernel
def _set_frame(part: FloatArray, frames: FloatArray, found: FloatArray) -> None:
    """Set the interpolated frame (3, 3), each of its vectors of length 1."""
    for row in range(3):
        length = 0.0
        for axis in range(3):
            found[row, axis] = _mix(part, frames[:, row, axis])
            length += found[row, axis] ** 2
        found[row] /= np.sqrt(length) if length > 0.0 else 1.0


@kernel
def _mix(part: FloatArray, values: FloatArray) -> float:
    return float(part[0] * values[0] + part[1] * values[1] + part[2] * values[2])


@kernel
def encode(owner: IntArray, frames: FloatArray, normals: NDArray[np.float32]) -> tuple[NDArray[np.uint8], int]:
    """Return the texels (h, w, 3) of some rows of a normal map, and how many have a normal of their own.

    Args:
        owner: (h, W) triangle of each texel, -1 for none.
        frames: (N, 3, 3) from `texel_frames`.
        normals: (N, 3) in the scene; 0 where the frame's own one stays.
    """
    found = np.empty((*owner.shape, 3), np.uint8)
    n, own, one = 0, 0, np.empty(3)
    for y in range(owner.shape[0]):
        for x in range(owner.shape[1]):
            one[0] = one[1] = 0.0
            one[2] = 1.0
            if owner[y, x] != NONE:
                own += _solve(frames[n], normals[n], one)
                n += 1
            for axis in range(3):
                found[y, x, axis] = int(np.floor(128.0 + 127.5 * one[axis]))
    return found, own


@kernel
def _solve(frame: FloatArray, normal: NDArray[np.float32], one: FloatArray) -> bool:
    """Set the unit vector of a normal in a frame, and return whether it has one in front of the surface."""
    t, b, n = frame
    volume = _span(t, b, n)
    if np.abs(volume) < FLAT:
        return False
    # Cramer's rule, since interpolated frames are not at right angles
    u, v, w = _span(normal, b, n) / volume, _span(t, normal, n) / volume, _span(t, b, normal) / volume
    if not w > 0.0:
        return False
    length = np.sqrt(u * u + v * v + w * w)
    one[0], one[1], one[2] = u / length, v / length, w / length
    return True


@kernel
def _span(a: NDArray[np.floating], b: NDArray[np.floating], c: NDArray[np.floating]) -> float:
    """Return the volume that three vectors span, positive where they are right-handed."""
    x, y, z = b[1] * c[2] - b[2] * c[1], b[2] * c[0] - b[0] * c[2], b[0] * c[1] - b[1] * c[0]
    return float(a[0] * x + a[1] * y + a[2] * z)


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
