"""Planes through depth maps, and their normals."""

import numpy as np
from numpy.typing import NDArray

from sfm_app.jit import kernel
from sfm_app.stereo.patch_match import PlaneArray
from sfm_app.stereo.view import DepthArray, FloatArray, View

SIGMA_PX = 2.5
"""Standard deviation of the weights in the window; smaller keeps more detail, larger makes smoother normals."""
RADIUS_PX = 5
MAX_STEP = 0.02
"""Relative depth difference beyond which a pixel belongs to another surface."""
MIN_WEIGHT = 0.25
"""Smallest share of the window's weight that must have a depth."""


def fit_planes(depth: DepthArray) -> PlaneArray:
    """Fit a plane to the surroundings of every pixel, by least squares.

    A plane n'X = 1 has the inverse depth n'x at the ray x = K^-1 (u, v, 1), which is linear in n and in the noise.

    Returns:
        (H, W, 3) inverse depth at the pixel and its slopes per pixel; 0 where the depth is unknown or isolated.
    """
    planes = np.zeros((*depth.shape, 3), np.float32)
    steps = np.arange(-RADIUS_PX, RADIUS_PX + 1)
    profile = np.exp(-0.5 * (steps / SIGMA_PX) ** 2)
    inverse = np.divide(1.0, depth, out=np.zeros(depth.shape), where=depth > 0, dtype=np.float64)
    window = np.outer(profile, profile)
    _fit(depth, inverse, (window, MIN_WEIGHT * float(window.sum())), planes)
    return planes


def plane_normals(planes: PlaneArray, view: View) -> NDArray[np.float32]:
    """Return (H, W, 3) unit normals in the camera frame that point to the camera; 0 where the inverse depth is 0.

    Args:
        planes: (H, W, 3) inverse depth and its slopes per pixel, from `fit_planes`.
        view: the photo.
    """
    normals = np.zeros_like(planes)
    _find_normals(planes, view.K, view.sample_px, normals)
    return normals


@kernel
def _find_normals(planes: PlaneArray, K: FloatArray, sample: float, normals: NDArray[np.float32]) -> None:
    for row in range(planes.shape[0]):
        for col in range(planes.shape[1]):
            a, b = float(planes[row, col, 1]), float(planes[row, col, 2])
            q = float(planes[row, col, 0])
            if q <= 0:
                continue
            # n'K^-1 (u, v, 1) = q + a (u - u0) + b (v - v0) for all u, v
            c = q - a * (col + sample) - b * (row + sample)
            x = a * K[0, 0] + b * K[1, 0] + c * K[2, 0]
            y = a * K[0, 1] + b * K[1, 1] + c * K[2, 1]
            z = a * K[0, 2] + b * K[1, 2] + c * K[2, 2]
            length = np.sqrt(x * x + y * y + z * z)
            normals[row, col, 0], normals[row, col, 1], normals[row, col, 2] = -x / length, -y / length, -z / length


@kernel
def _fit(depth: DepthArray, inverse: FloatArray, weights: tuple[FloatArray, float], planes: PlaneArray) -> None:
    for row in range(depth.shape[0]):
        for col in range(depth.shape[1]):
            if depth[row, col] > 0:
                g0, gu, gv = _slopes(depth, inverse, row, col, weights)
                if g0 > 0:
                    planes[row, col, 0], planes[row, col, 1], planes[row, col, 2] = g0, gu, gv


@kernel
def _slopes(
    depth: DepthArray, inverse: FloatArray, row: int, col: int, weights: tuple[FloatArray, float]
) -> tuple[float, float, float]:
    """Fit the inverse depth g0 + gu du + gv dv, (du, dv) in pixels from (col, row); g0 = 0 where undetermined."""
    window, least = weights
    height, width = depth.shape
    z = depth[row, col]
    n, su, sv, suu, suv, svv, q, qu, qv = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for i in range(max(row - RADIUS_PX, 0), min(row + RADIUS_PX + 1, height)):
        for j in range(max(col - RADIUS_PX, 0), min(col + RADIUS_PX + 1, width)):
            other = depth[i, j]
            if other <= 0 or abs(other - z) > MAX_STEP * z:
                continue
            weight = window[i - row + RADIUS_PX, j - col + RADIUS_PX]
            du, dv, share = float(j - col), float(i - row), weight * inverse[i, j]
            n += weight
            su += weight * du
            sv += weight * dv
            suu += weight * du * du
            suv += weight * du * dv
            svv += weight * dv * dv
            q += share
            qu += du * share
            qv += dv * share
    if n < least:
        return 0.0, 0.0, 0.0
    suu, suv, svv = suu - su * su / n, suv - su * sv / n, svv - sv * sv / n
    qu, qv = qu - su * q / n, qv - sv * q / n
    det = suu * svv - suv * suv
    if det < 1e-3 * n * n:  # all on one line
        return 0.0, 0.0, 0.0
    gu, gv = (svv * qu - suv * qv) / det, (suu * qv - suv * qu) / det
    return (q - gu * su - gv * sv) / n, gu, gv
