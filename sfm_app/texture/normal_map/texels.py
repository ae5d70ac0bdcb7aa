"""Texels of a normal map: the frames along the texture at their points, and normals in these frames.

Tangent, bitangent and normal are interpolated, each by itself, and then normalized, as three.js and Khronos' viewer do.
MikkTSpace normalizes none of them, and makes the bitangent from the interpolated two.
"""

import numpy as np
from numpy.typing import NDArray

from sfm_app.jit import kernel
from sfm_app.texture.facets import NONE, IntArray
from sfm_app.texture.painting import set_shares

FloatArray = NDArray[np.float64]

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
