"""Draw a surface into a photo: which triangle each pixel shows, and how far away."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sfm_app.jit import kernel

FloatArray = NDArray[np.float64]
IndexArray = NDArray[np.int64]

NOTHING = -1
NEAREST = 1e-6
"""Depth below which nothing is drawn, in scene units. By definition: rounding."""


@dataclass(frozen=True, slots=True, eq=False)
class Raster:
    """A surface as a photo sees it."""

    depth: NDArray[np.float32]
    """(H, W) along the optical axis; infinite where nothing is."""
    face: NDArray[np.int32]
    """(H, W) triangle; NOTHING where none is, or where its back is seen."""


def rasterize(vertices: FloatArray, faces: IndexArray, projection: FloatArray, size: tuple[int, int]) -> Raster:
    """Draw a surface into a photo without distortion, at pixel centers.

    Args:
        vertices: (V, 3) in the world.
        faces: (T, 3), counterclockwise seen from outside.
        projection: (3, 4) K [R | t].
        size: height and width in pixels.
    """
    nearness, face = np.zeros(size, np.float32), np.full(size, NOTHING, np.int32)
    _draw(project_vertices(vertices, projection), faces, nearness, face)
    with np.errstate(divide="ignore"):
        return Raster(np.float32(1.0) / nearness, face)


def project_vertices(vertices: FloatArray, projection: FloatArray) -> FloatArray:
    """Return the pixels x, y of vertices and 1 / depth (V, 3); -1 for the last where one is not in front of the photo.

    Args:
        vertices: (V, 3).
        projection: (3, 4) K [R | t].
    """
    seen = np.empty((len(vertices), 3))
    _project(vertices, projection, seen)
    return seen


@kernel
def _project(vertices: FloatArray, P: FloatArray, seen: FloatArray) -> None:
    """Fill in the pixels of vertices, and 1 / depth, or -1 for those that are not in front of the photo."""
    for k in range(len(vertices)):
        x, y, z = vertices[k, 0], vertices[k, 1], vertices[k, 2]
        w = P[2, 0] * x + P[2, 1] * y + P[2, 2] * z + P[2, 3]
        near = 1.0 / w if w > NEAREST else -1.0
        seen[k, 0] = near * (P[0, 0] * x + P[0, 1] * y + P[0, 2] * z + P[0, 3])
        seen[k, 1] = near * (P[1, 0] * x + P[1, 1] * y + P[1, 2] * z + P[1, 3])
        seen[k, 2] = near


@kernel
def _draw(seen: FloatArray, faces: IndexArray, nearness: NDArray[np.float32], face: NDArray[np.int32]) -> None:
    """Fill in 1 / depth, which is linear in the photo, and the triangles; `seen` has pixels and 1 / depth."""
    height, width = face.shape
    for f in range(len(faces)):
        a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
        ax, ay, bx, by, cx, cy = seen[a, 0], seen[a, 1], seen[b, 0], seen[b, 1], seen[c, 0], seen[c, 1]
        low, high = min(ay, by, cy), max(ay, by, cy)
        if high < 0.5 or low > height - 0.5 or min(seen[a, 2], seen[b, 2], seen[c, 2]) < 0.0:
            continue
        left, right = min(ax, bx, cx), max(ax, bx, cx)
        area = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)
        if right < 0.5 or left > width - 0.5 or area == 0.0:
            continue
        first_column, last_column = max(int(left + 0.5), 0), min(int(right + 0.5), width)
        near, over = seen[a, 2], 1.0 / area
        # changes of both weights per pixel, and of nearness with them
        bdx, bdy, cdx, cdy = (cy - ay) * over, (ax - cx) * over, (ay - by) * over, (bx - ax) * over
        to_b, to_c = seen[b, 2] - near, seen[c, 2] - near
        shown = f if area < 0.0 else NOTHING  # rows run down: what is counterclockwise has a negative area here
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
