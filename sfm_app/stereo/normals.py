"""Normals of a depth map."""

import numpy as np
from numpy.typing import NDArray

from sfm_app.jit import kernel
from sfm_app.stereo.view import DepthArray, FloatArray, View

SIGMA_PX = 2.5
"""How fast the weight of a pixel falls off; smaller keeps more detail, larger takes more noise out of the normals."""
RADIUS_PX = 5
MAX_STEP = 0.02
"""Relative depth difference beyond which a pixel belongs to another surface."""
MIN_WEIGHT = 0.25
"""Least share of the window that has to be filled."""


def fit_planes(view: View, depth: DepthArray) -> tuple[NDArray[np.float32], DepthArray]:
    """Plane through the surroundings of every pixel, by least squares.

    A plane n'X = 1 has the inverse depth n'x at the ray x = K^-1 (u, v, 1), which is linear in n and in the noise.

    Returns:
        (H, W, 3) unit normals in the camera frame that point to the camera, and (H, W) the plane's depth at the pixel;
        both 0 where there is no depth or too little around it.
    """
    normals = np.zeros((*depth.shape, 3), np.float32)
    planes = np.zeros_like(depth)
    steps = np.arange(-RADIUS_PX, RADIUS_PX + 1)
    profile = np.exp(-0.5 * (steps / SIGMA_PX) ** 2)
    K_inv = np.asarray(np.linalg.inv(view.K), np.float64)
    _fit(depth, K_inv, view.sample_px, np.outer(profile, profile), normals, planes)
    return normals, planes


@kernel
def _fit(
    depth: DepthArray,
    K_inv: FloatArray,
    sample_px: float,
    window: FloatArray,
    normals: NDArray[np.float32],
    planes: DepthArray,
) -> None:
    for row in range(depth.shape[0]):
        for col in range(depth.shape[1]):
            if depth[row, col] <= 0:
                continue
            g0, gu, gv = _slopes(depth, row, col, window)
            if g0 <= 0:
                continue
            # n'K^-1 (u, v, 1) = g0 + gu (u - u0) + gv (v - v0) for all u, v:
            # solve K^-1' n = (gu, gv, g0 - gu u0 - gv v0),
            # K^-1 being upper triangular
            nx = gu / K_inv[0, 0]
            ny = (gv - K_inv[0, 1] * nx) / K_inv[1, 1]
            nz = g0 - gu * (col + sample_px) - gv * (row + sample_px) - K_inv[0, 2] * nx - K_inv[1, 2] * ny
            length = np.sqrt(nx * nx + ny * ny + nz * nz)
            normals[row, col, 0] = -nx / length
            normals[row, col, 1] = -ny / length
            normals[row, col, 2] = -nz / length
            planes[row, col] = 1.0 / g0


@kernel
def _slopes(depth: DepthArray, row: int, col: int, window: FloatArray) -> tuple[float, float, float]:
    """Weighted fit of the inverse depth g0 + gu du + gv dv, (du, dv) in pixels from (col, row); g0 = 0: none."""
    height, width = depth.shape
    z = depth[row, col]
    n, su, sv, suu, suv, svv, q, qu, qv = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for i in range(max(row - RADIUS_PX, 0), min(row + RADIUS_PX + 1, height)):
        for j in range(max(col - RADIUS_PX, 0), min(col + RADIUS_PX + 1, width)):
            other = depth[i, j]
            if other <= 0 or abs(other - z) > MAX_STEP * z:
                continue
            weight = window[i - row + RADIUS_PX, j - col + RADIUS_PX]
            du, dv, inverse = float(j - col), float(i - row), weight / other
            n += weight
            su += weight * du
            sv += weight * dv
            suu += weight * du * du
            suv += weight * du * dv
            svv += weight * dv * dv
            q += inverse
            qu += du * inverse
            qv += dv * inverse
    if n < MIN_WEIGHT * np.sum(window):
        return 0.0, 0.0, 0.0
    suu, suv, svv = suu - su * su / n, suv - su * sv / n, svv - sv * sv / n
    qu, qv = qu - su * q / n, qv - sv * q / n
    det = suu * svv - suv * suv
    if det < 1e-3 * n * n:  # all on one line
        return 0.0, 0.0, 0.0
    gu, gv = (svv * qu - suv * qv) / det, (suu * qv - suv * qu) / det
    return (q - gu * su - gv * sv) / n, gu, gv
