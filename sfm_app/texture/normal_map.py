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


@kernel
def interpolate_frames(
    owner: IntArray, top: int, corners: FloatArray, points: FloatArray, frames: FloatArray
) -> tuple[NDArray[np.float32], FloatArray]:
    """Return points (N, 3) and frames (N, 3, 3), of unit rows, of all texels with an owner, row by row.

    `owner` (h, W) is the triangle of each texel in rows of a page from `top` on, -1 for none. The corners (T, 3, 2) are
    in texels, the points (T, 3, 3) in the scene; the frames (T, 3, 3, 3) come from `corner_frames`.
    """
    count, n, part = np.count_nonzero(owner != NONE), 0, np.empty(3)
    texel_points, texel_frames = np.empty((count, 3), np.float32), np.empty((count, 3, 3))
    for y in range(owner.shape[0]):
        for x in range(owner.shape[1]):
            f = owner[y, x]
            if f == NONE:
                continue
            set_shares(corners[f], x + 0.5, top + y + 0.5, part)
            for axis in range(3):
                texel_points[n, axis] = _mix(part, points[f, :, axis])
            _set_frame(part, frames[f], texel_frames[n])
            n += 1
    return texel_points, texel_frames


@kernel
def _set_frame(part: FloatArray, frames: FloatArray, frame: FloatArray) -> None:
    for row in range(3):
        length = 0.0
        for axis in range(3):
            frame[row, axis] = _mix(part, frames[:, row, axis])
            length += frame[row, axis] ** 2
        frame[row] /= np.sqrt(length) if length > 0.0 else 1.0


@kernel
def _mix(part: FloatArray, values: FloatArray) -> float:
    return float(part[0] * values[0] + part[1] * values[1] + part[2] * values[2])


@kernel
def encode(owner: IntArray, frames: FloatArray, normals: NDArray[np.float32]) -> tuple[NDArray[np.uint8], int]:
    """Return the texels (h, w, 3) of rows of a normal map, and how many have a fine normal (N, 3), not 0."""
    texels = np.empty((*owner.shape, 3), np.uint8)
    n, own, one = 0, 0, np.empty(3)
    for y in range(owner.shape[0]):
        for x in range(owner.shape[1]):
            one[0] = one[1] = 0.0
            one[2] = 1.0
            if owner[y, x] != NONE:
                own += _solve(frames[n], normals[n], one)
                n += 1
            for axis in range(3):
                texels[y, x, axis] = int(np.floor(128.0 + 127.5 * one[axis]))
    return texels, own


@kernel
def _solve(frame: FloatArray, normal: NDArray[np.float32], one: FloatArray) -> bool:
    """Set the unit vector of a normal in a frame; return False for a flat frame or a normal behind the surface."""
    t, b, n = frame
    volume = _span(t, b, n)
    if np.abs(volume) < 1e-6:
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
    """Return the signed volume of three vectors, positive if right-handed."""
    x, y, z = b[1] * c[2] - b[2] * c[1], b[2] * c[0] - b[0] * c[2], b[0] * c[1] - b[1] * c[0]
    return float(a[0] * x + a[1] * y + a[2] * z)


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
