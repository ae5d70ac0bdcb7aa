"""How two photos agree on a surface, and which way each vertex would have to move.

A photo is seen through the surface from another one. Where both differ after local brightness and contrast have been
made equal, the surface is too near or too far: the difference divided by its derivative along the viewing ray is the
distance (Vu, Labatut, Pons, Keriven: High accuracy and visibility-consistent dense multiview stereo. PAMI 2012, with a
gradient descent; here in Gauss-Newton steps, which need a tenth of the iterations).
"""

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from sfm_app.jit import kernel
from sfm_app.meshing.refinement.photo_levels import Gray, PhotoLevel
from sfm_app.meshing.refinement.rasterize import Raster

FloatArray = NDArray[np.float64]
IndexArray = NDArray[np.int64]

WINDOW_PX = 7
"""Side of the window in which brightness and contrast are made equal. Chosen on `ornament`."""
NOISE_GRAY = 3.0
"""Standard deviation of gray levels that the surface does not explain. Chosen by hand."""
OUTLIER = 3.0
"""Differences of this many deviations count half (Cauchy). By definition of the weight."""
UNRELATED, RELATED = 0.1, 0.5
"""Correlations of a window at which it counts nothing, and fully. Chosen by hand."""
LEAST_FACING = 0.2
"""Least cosine between the normal and the rays to both photos. Chosen by hand."""
HIDDEN = 0.003
"""Relative difference in depth from what the other photo sees there, beyond which a place is hidden from it. Chosen by
hand."""
LEAST_SEEN = 0.6
"""Least share of a window that both photos see. Chosen by hand."""


@dataclass(slots=True, eq=False)
class Pull:
    """What photos say about the displacement d of each vertex along its normal: cost - 2 g d + h d^2."""

    g: FloatArray
    """(V,)."""
    h: FloatArray
    """(V,)."""
    correlation: float = 0.0
    """Sum of the correlations over pixels."""
    pixels: float = 0.0
    """Pixels that were compared."""

    @classmethod
    def zeros(cls, count: int) -> "Pull":
        """Make that of `count` vertices which nothing pulls."""
        return cls(np.zeros(count), np.zeros(count))

    def add(self, other: "Pull") -> None:
        """Add what other photos say."""
        self.g += other.g
        self.h += other.h
        self.correlation += other.correlation
        self.pixels += other.pixels


def compare(
    surface: tuple[FloatArray, FloatArray, IndexArray],
    here: tuple[PhotoLevel, Raster],
    there: tuple[PhotoLevel, Gray],
    pull: Pull,
) -> None:
    """Add what a pair of photos says about the displacement of the vertices.

    Args:
        surface: vertices (V, 3), normals (V, 3), and faces (T, 3).
        here: a photo, and the surface in it.
        there: the other photo, and the depths (H, W) of the surface in it.
        pull: changed.
    """
    vertices, normals, faces = surface
    level, raster = here
    other, other_depth = there
    shape = level.gray.shape
    seen, slope, mask = (np.zeros(shape, np.float32) for _ in range(3))
    _look_through(
        (vertices, normals, faces), (raster.face, raster.weights), (level.center, other.center),
        other.projection, (other.gray, other.by_x, other.by_y, other_depth), (seen, slope, mask),
    )  # fmt: skip
    difference, gain, correlation, full = _difference(level.gray, seen, mask)
    related = np.clip((correlation - UNRELATED) / (RELATED - UNRELATED), 0.0, 1.0)
    weight = mask * full * related / (1.0 + (difference / (OUTLIER * NOISE_GRAY)) ** 2) / (2.0 * NOISE_GRAY**2)
    _sum_up(raster.face, raster.weights, faces, difference, gain * slope, weight.astype(np.float32), pull.g, pull.h)
    pull.correlation += float((correlation * mask).sum(dtype=np.float64))
    pull.pixels += float(mask.sum(dtype=np.float64))


def _difference(gray: Gray, seen: Gray, mask: Gray) -> tuple[Gray, Gray, Gray, NDArray[np.bool_]]:
    """Return how photos differ where their windows have equal mean and contrast, and the gain that makes them equal.

    Also their correlation, and where a window is seen well enough; all (H, W).
    """
    side = (WINDOW_PX, WINDOW_PX)
    share = cv2.blur(mask, side)
    count = np.maximum(share, 1e-6)
    mean, other_mean = cv2.blur(gray * mask, side) / count, cv2.blur(seen * mask, side) / count
    noise = NOISE_GRAY**2
    variance = np.maximum(cv2.blur(gray * gray * mask, side) / count - mean * mean, 0.0) + noise
    other_variance = np.maximum(cv2.blur(seen * seen * mask, side) / count - other_mean * other_mean, 0.0) + noise
    common = cv2.blur(gray * seen * mask, side) / count - mean * other_mean
    gain = np.sqrt(variance / other_variance)
    difference = (gray - mean) - gain * (seen - other_mean)
    correlation = common / np.sqrt(variance * other_variance)
    return (
        np.asarray(difference, np.float32), np.asarray(gain, np.float32), np.asarray(correlation, np.float32),
        share > LEAST_SEEN,
    )  # fmt: skip


@kernel
def _look_through(
    surface: Any, raster: Any, centers: Any, projection: FloatArray, other: Any, found: Any,
) -> None:  # fmt: skip
    """Fill in what the other photo shows at each pixel, its change per displacement of the surface, and where it sees.

    Arguments as in `compare`; found: gray levels, changes and 0 or 1, (H, W) each.
    """
    vertices, normals, faces = surface
    face, weights = raster
    here, there = centers
    P = projection
    gray, by_x, by_y, other_depth = other
    seen, slope, mask = found
    height, width = gray.shape
    place, normal = np.empty(3), np.empty(3)
    for i in range(face.shape[0]):
        for j in range(face.shape[1]):
            f = face[i, j]
            if f < 0:
                continue
            b, c = weights[i, j, 0], weights[i, j, 1]
            a = 1.0 - b - c
            for k in range(3):
                place[k] = a * vertices[faces[f, 0], k] + b * vertices[faces[f, 1], k] + c * vertices[faces[f, 2], k]
                normal[k] = a * normals[faces[f, 0], k] + b * normals[faces[f, 1], k] + c * normals[faces[f, 2], k]
            w = P[2, 0] * place[0] + P[2, 1] * place[1] + P[2, 2] * place[2] + P[2, 3]
            if w <= 0.0:
                continue
            u = (P[0, 0] * place[0] + P[0, 1] * place[1] + P[0, 2] * place[2] + P[0, 3]) / w
            v = (P[1, 0] * place[0] + P[1, 1] * place[1] + P[1, 2] * place[2] + P[1, 3]) / w
            col, row = int(np.floor(u - 0.5)), int(np.floor(v - 0.5))
            if col < 0 or row < 0 or col >= width - 1 or row >= height - 1:
                continue
            near = 0
            for m in range(row, row + 2):
                for n in range(col, col + 2):
                    near += abs(other_depth[m, n] - w) <= HIDDEN * w
            if near < 2:
                continue
            facing, ray = _cosine(normal, place, here)
            if facing < LEAST_FACING or _cosine(normal, place, there)[0] < LEAST_FACING:
                continue
            x, y = u - 0.5 - col, v - 0.5 - row
            seen[i, j] = _interpolate(gray, row, col, x, y)
            # along the ray, the surface moves by 1 / facing per displacement, towards the photo
            scale = 1.0 / (ray * facing)
            step_x, step_y, step_z = (
                scale * (here[0] - place[0]),
                scale * (here[1] - place[1]),
                scale * (here[2] - place[2]),
            )
            dw = P[2, 0] * step_x + P[2, 1] * step_y + P[2, 2] * step_z
            du = (P[0, 0] * step_x + P[0, 1] * step_y + P[0, 2] * step_z - u * dw) / w
            dv = (P[1, 0] * step_x + P[1, 1] * step_y + P[1, 2] * step_z - v * dw) / w
            slope[i, j] = _interpolate(by_x, row, col, x, y) * du + _interpolate(by_y, row, col, x, y) * dv
            mask[i, j] = 1.0


@kernel
def _cosine(normal: FloatArray, place: FloatArray, center: FloatArray) -> tuple[float, float]:
    """Return the cosine between a normal and the way to a photo, and the length of that way."""
    dot, square, length = 0.0, 0.0, 0.0
    for k in range(3):
        way = center[k] - place[k]
        dot += normal[k] * way
        square += normal[k] * normal[k]
        length += way * way
    length = np.sqrt(length)
    return dot / max(np.sqrt(square) * length, 1e-300), length


@kernel
def _interpolate(image: Gray, row: int, col: int, x: float, y: float) -> float:
    """Return the bilinear value at (x, y) in [0, 1) from a pixel."""
    upper = image[row, col] + x * (image[row, col + 1] - image[row, col])
    lower = image[row + 1, col] + x * (image[row + 1, col + 1] - image[row + 1, col])
    return float(upper + y * (lower - upper))


@kernel
def _sum_up(
    face: NDArray[np.int32], weights: Gray, faces: IndexArray, difference: Gray, slope: Gray, weight: Gray,
    g: FloatArray, h: FloatArray,
) -> None:  # fmt: skip
    for i in range(face.shape[0]):
        for j in range(face.shape[1]):
            if weight[i, j] <= 0.0:
                continue
            f, second, third = face[i, j], weights[i, j, 0], weights[i, j, 1]
            pull = weight[i, j] * slope[i, j] * difference[i, j]
            stiff = weight[i, j] * slope[i, j] * slope[i, j]
            for k in range(3):
                share = second if k == 1 else third if k == 2 else 1.0 - second - third
                g[faces[f, k]] += share * pull
                h[faces[f, k]] += share * stiff
