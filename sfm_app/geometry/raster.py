"""A surface drawn into a photo."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sfm_app.jit import kernel
from sfm_app.types import PosedPhoto
from sfm_app.types.arrays import FloatArray, IndexArray

NOTHING = -1
"""Triangle of a pixel that shows none. By definition."""


@dataclass(frozen=True, slots=True, eq=False)
class Raster:
    """A surface drawn into a photo."""

    depth: NDArray[np.float32]
    """(H, W) along the optical axis; infinite without surface."""
    face: NDArray[np.int32]
    """(H, W) triangle; NOTHING without surface, or where the photo sees its back."""


def rasterize(vertices: FloatArray, faces: IndexArray, photo: PosedPhoto) -> Raster:
    """Draw a surface, its triangles counterclockwise from outside, into a photo at pixel centers."""
    size = photo.height, photo.width
    nearness, face = np.zeros(size, np.float32), np.full(size, NOTHING, np.int32)
    draw(project_vertices(vertices, photo.projection), faces, nearness, face)
    with np.errstate(divide="ignore"):
        return Raster(np.float32(1.0) / nearness, face)


def project_vertices(vertices: FloatArray, projection: FloatArray) -> FloatArray:
    """Return pixels x, y and 1 / depth (V, 3) of vertices (V, 3); the last is -1 behind the photo."""
    x, y, z = vertices.T
    u, v, depth = (row[0] * x + row[1] * y + row[2] * z + row[3] for row in projection)
    # in scene units; by definition: rounding
    near = np.divide(1.0, depth, out=np.full(len(depth), -1.0), where=depth > 1e-6)
    return np.stack([near * u, near * v, near], axis=1)


@kernel
def draw(pixels: FloatArray, faces: IndexArray, nearness: NDArray[np.float32], face: NDArray[np.int32]) -> None:
    """Fill in 1 / depth, which is linear in the photo, and the triangles; `pixels` (V, 3) as `project_vertices`."""
    height, width = face.shape
    for f in range(len(faces)):
        a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
        ax, ay, bx, by, cx, cy = pixels[a, 0], pixels[a, 1], pixels[b, 0], pixels[b, 1], pixels[c, 0], pixels[c, 1]
        low, high = min(ay, by, cy), max(ay, by, cy)
        if high < 0.5 or low > height - 0.5 or min(pixels[a, 2], pixels[b, 2], pixels[c, 2]) < 0.0:
            continue
        left, right = min(ax, bx, cx), max(ax, bx, cx)
        area = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)
        if right < 0.5 or left > width - 0.5 or area == 0.0:
            continue
        first_column, last_column = max(int(left + 0.5), 0), min(int(right + 0.5), width)
        near, over = pixels[a, 2], 1.0 / area
        # changes of both weights per pixel, and of nearness with them
        bdx, bdy, cdx, cdy = (cy - ay) * over, (ax - cx) * over, (ay - by) * over, (bx - ax) * over
        to_b, to_c = pixels[b, 2] - near, pixels[c, 2] - near
        shown = f if area < 0.0 else NOTHING  # rows run down: counterclockwise triangles have a negative area
        for i in range(max(int(low + 0.5), 0), min(int(high + 0.5), height)):
            y = i + 0.5 - ay
            for j in range(first_column, last_column):
                x = j + 0.5 - ax
                second, third = x * bdx + y * bdy, x * cdx + y * cdy
                if second < 0.0 or third < 0.0 or second + third > 1.0:
                    continue
                here = np.float32(near + second * to_b + third * to_c)
                if here > nearness[i, j]:
                    nearness[i, j] = here
                    face[i, j] = shown
