"""Draw a surface into a photo: which triangle each pixel shows, where on it, and how far away."""

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
    weights: NDArray[np.float32]
    """(H, W, 2) of the second and the third corner, at the place on the triangle; the three sum to 1."""


def rasterize(vertices: FloatArray, faces: IndexArray, projection: FloatArray, size: tuple[int, int]) -> Raster:
    """Draw a surface into a photo without distortion, at pixel centers.

    Args:
        vertices: (V, 3) in the world.
        faces: (T, 3), counterclockwise seen from outside.
        projection: (3, 4) K [R | t].
        size: height and width in pixels.
    """
    depth = np.full(size, np.inf, np.float32)
    face, weights = np.full(size, NOTHING, np.int32), np.zeros((*size, 2), np.float32)
    seen = vertices @ projection[:, :3].T + projection[:, 3]
    ahead = np.where(seen[:, 2] > NEAREST, seen[:, 2], 1.0)
    seen[:, :2] /= ahead[:, None]
    _draw(seen, faces, depth, face, weights)
    return Raster(depth, face, weights)


@kernel
def _draw(
    seen: FloatArray,
    faces: IndexArray,
    depth: NDArray[np.float32],
    face: NDArray[np.int32],
    weights: NDArray[np.float32],
) -> None:
    height, width = depth.shape
    for f in range(len(faces)):
        a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
        if min(seen[a, 2], seen[b, 2], seen[c, 2]) <= NEAREST:
            continue
        ax, ay, bx, by, cx, cy = seen[a, 0], seen[a, 1], seen[b, 0], seen[b, 1], seen[c, 0], seen[c, 1]
        left, right = np.ceil(min(ax, bx, cx) - 0.5), np.floor(max(ax, bx, cx) - 0.5)
        top, bottom = np.ceil(min(ay, by, cy) - 0.5), np.floor(max(ay, by, cy) - 0.5)
        area = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)
        if area == 0.0 or right < 0 or bottom < 0 or left >= width or top >= height:
            continue
        near_a, near_b, near_c = 1.0 / seen[a, 2], 1.0 / seen[b, 2], 1.0 / seen[c, 2]
        for i in range(max(int(top), 0), min(int(bottom), height - 1) + 1):
            for j in range(max(int(left), 0), min(int(right), width - 1) + 1):
                x, y = j + 0.5, i + 0.5
                second = ((x - ax) * (cy - ay) - (y - ay) * (cx - ax)) / area
                third = ((bx - ax) * (y - ay) - (by - ay) * (x - ax)) / area
                first = 1.0 - second - third
                if first < 0.0 or second < 0.0 or third < 0.0:
                    continue
                z = 1.0 / (first * near_a + second * near_b + third * near_c)
                if z < depth[i, j]:
                    depth[i, j] = z
                    # rows run down, so what is counterclockwise in the world has a negative area here
                    face[i, j] = f if area < 0.0 else NOTHING
                    weights[i, j, 0], weights[i, j, 1] = second * near_b * z, third * near_c * z
