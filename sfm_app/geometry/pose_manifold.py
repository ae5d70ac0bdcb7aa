"""Relative poses for kernels: twelve numbers, R by rows and then the unit vector t; five degrees of freedom."""

import numpy as np
from numpy.typing import NDArray

from sfm_app.jit import kernel

FloatArray = NDArray[np.float64]

POSE_DOF = 5
"""Parameters of a relative pose: three of rotation, two of direction. Counted."""


@kernel
def write_essential(pose: FloatArray, E: FloatArray) -> None:
    """Write the essential matrix [t]x R of a pose.

    Args:
        pose: (12,) R by rows, then the unit vector t.
        E: (3, 3), written to.
    """
    x, y, z = pose[9], pose[10], pose[11]
    for j in range(3):
        E[0, j] = y * pose[6 + j] - z * pose[3 + j]
        E[1, j] = z * pose[j] - x * pose[6 + j]
        E[2, j] = x * pose[3 + j] - y * pose[j]


@kernel
def retract(pose: FloatArray, step: FloatArray) -> FloatArray:
    """Return the pose (12,) after a step: R turned by exp([w]x), t moved in its tangent plane.

    Args:
        pose: (12,) R by rows, then the unit vector t.
        step: (5,) w in radians, then the move of t along two unit vectors perpendicular to it.
    """
    wx, wy, wz = step[0], step[1], step[2]
    angle = np.sqrt(wx * wx + wy * wy + wz * wz)
    sine = np.sin(angle) / angle if angle > 1e-12 else 1.0
    versine = (1.0 - np.cos(angle)) / (angle * angle) if angle > 1e-6 else 0.5
    out = np.empty(12)
    for j in range(3):
        a, b, c = pose[j], pose[3 + j], pose[6 + j]
        dot = wx * a + wy * b + wz * c
        cosine = 1.0 - versine * angle * angle
        out[j] = cosine * a + sine * (wy * c - wz * b) + versine * dot * wx
        out[3 + j] = cosine * b + sine * (wz * a - wx * c) + versine * dot * wy
        out[6 + j] = cosine * c + sine * (wx * b - wy * a) + versine * dot * wz
    x, y, z = pose[9], pose[10], pose[11]
    # two unit vectors perpendicular to t (Duff et al. 2017)
    sign = 1.0 if z >= 0.0 else -1.0
    p = -1.0 / (sign + z)
    q = x * y * p
    u, v = step[3], step[4]
    nx = x + u * (1.0 + sign * x * x * p) + v * q
    ny = y + u * sign * q + v * (sign + y * y * p)
    nz = z - u * sign * x - v * y
    length = np.sqrt(nx * nx + ny * ny + nz * nz)
    out[9], out[10], out[11] = nx / length, ny / length, nz / length
    return out
