"""Colors of a surface's vertices, from the photos that see them.

SciPy is imported where it is used: a program that only estimates fundamental matrices starts without it.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sfm_app.jit import kernel
from sfm_app.meshing.visibility import CONFIRMED, DepthView, FloatArray

ColorImage = NDArray[np.uint8]
"""(H, W, 3) RGB."""


@dataclass(slots=True, eq=False)
class Paint:
    """Weighted sums of colors over photos, and the sums of their weights."""

    total: NDArray[np.float32]
    """(V, 3) weighted sum of the colors."""
    weight: NDArray[np.float32]
    """(V,)."""

    @classmethod
    def zeros(cls, count: int) -> "Paint":
        """Make the zero sums of `count` vertices."""
        return cls(np.zeros((count, 3), np.float32), np.zeros(count, np.float32))

    def add(self, at: NDArray[np.int64], other: "Paint") -> None:
        """Add the colors of another photo.

        Args:
            at: (N,) the vertices that it sampled, each once.
            other: its colors at these.
        """
        self.total[at] += other.total
        self.weight[at] += other.weight

    def mean_colors(self, points: FloatArray) -> NDArray[np.uint8]:
        """Return (V, 3) mean colors of the photos; vertices that no photo shows have that of the nearest one shown.

        Args:
            points: (V, 3) vertices.
        """
        from scipy.spatial import cKDTree

        mean = self.total / np.maximum(self.weight, np.finfo(np.float32).tiny)[:, None]
        colors, shown = np.rint(mean).astype(np.uint8), self.weight > 0
        if shown.any() and not shown.all():
            colors[~shown] = colors[shown][cKDTree(points[shown]).query(points[~shown])[1]]
        return colors


def sample_colors(
    points: FloatArray, normals: FloatArray, verdict: NDArray[np.uint8], eye: DepthView, image: ColorImage
) -> Paint:
    """Sample colors of one photo at the points that it confirms.

    The weight of a color is the area of a unit patch at the point, in pixels.

    Args:
        points: (N, 3).
        normals: (N, 3) unit.
        verdict: (N,) from `judge`.
        eye: the photo's camera.
        image: (H, W, 3) the same field of view as the depth map, at any size.
    """
    paint = Paint.zeros(len(points))
    scale = np.array(image.shape[:2]) / eye.depth.shape
    projection = np.diag([scale[1], scale[0], 1.0]) @ eye.projection
    seen = verdict == CONFIRMED
    _sample(points, normals, seen, projection, eye.center, eye.focal_px**2, image, paint.total, paint.weight)
    return paint


@kernel
def _sample(
    points: FloatArray,
    normals: FloatArray,
    seen: NDArray[np.bool_],
    P: FloatArray,
    center: FloatArray,
    scale: float,
    image: ColorImage,
    total: NDArray[np.float32],
    weight: NDArray[np.float32],
) -> None:
    height, width = image.shape[0], image.shape[1]
    for k in range(len(points)):
        if not seen[k]:
            continue
        X, Y, Z = points[k, 0], points[k, 1], points[k, 2]
        z = P[2, 0] * X + P[2, 1] * Y + P[2, 2] * Z + P[2, 3]
        u = (P[0, 0] * X + P[0, 1] * Y + P[0, 2] * Z + P[0, 3]) / z - 0.5
        v = (P[1, 0] * X + P[1, 1] * Y + P[1, 2] * Z + P[1, 3]) / z - 0.5
        col, row = int(np.floor(u)), int(np.floor(v))
        if not (0 <= col < width - 1 and 0 <= row < height - 1):
            continue
        x, y, w = center[0] - X, center[1] - Y, center[2] - Z
        facing = (normals[k, 0] * x + normals[k, 1] * y + normals[k, 2] * w) / np.sqrt(x * x + y * y + w * w)
        share = facing * scale / (z * z)
        weight[k] = share
        right, down = u - col, v - row
        for c in range(3):
            upper = image[row, col, c] * (1 - right) + image[row, col + 1, c] * right
            lower = image[row + 1, col, c] * (1 - right) + image[row + 1, col + 1, c] * right
            total[k, c] = share * (upper * (1 - down) + lower * down)
