"""What a camera that only turned would see: x2 ~ K2 R K1^-1 x1, whatever the depth (Hartley and Zisserman 8.4.2)."""

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]

TRIMMED = 0.8
"""Share of the matches, those that fit best, that the rotation is fitted to again."""
FITS = 2


def nearest_rotation(d1: FloatArray, d2: FloatArray) -> FloatArray:
    """The rotation (3, 3) that brings unit directions d1 (N, 3) nearest to d2 (N, 3), least squares (Kabsch 1976)."""
    U, _, Vt = np.linalg.svd(np.einsum("ni,nj->ij", d2, d1))
    return np.asarray(U @ np.diag([1.0, 1.0, np.linalg.det(U) * np.linalg.det(Vt)]) @ Vt)


def rotation_distances(x1: FloatArray, x2: FloatArray, K1: FloatArray, K2: FloatArray) -> FloatArray:
    """How far matches are from what a rotation of the camera explains; the rotation is fitted to most of them.

    Args:
        x1: (N, 2) pixels, N >= 2.
        x2: (N, 2) pixels, the partners.
        K1: (3, 3) camera matrix of view 1.
        K2: (3, 3) of view 2.

    Returns:
        (N,) pixels in view 2; inf behind the camera.
    """
    d1, d2 = (_directions(x, K) for x, K in ((x1, K1), (x2, K2)))
    kept = np.ones(len(x1), bool)
    for _ in range(FITS):
        seen = d1 @ nearest_rotation(d1[kept], d2[kept]).T @ K2.T
        with np.errstate(divide="ignore", invalid="ignore"):
            distances = np.hypot(*(seen[:, :2] / seen[:, 2:] - x2).T)
        distances[~(seen[:, 2] > 0)] = np.inf
        kept = distances <= np.quantile(distances, TRIMMED, method="lower")
    return np.asarray(distances)


def _directions(x: FloatArray, K: FloatArray) -> FloatArray:
    rays = np.column_stack([x, np.ones(len(x))]) @ np.linalg.inv(K).T
    return np.asarray(rays / np.linalg.norm(rays, axis=1, keepdims=True))
