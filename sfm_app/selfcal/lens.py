"""From pixels to rays through a lens with one radial term.

Ours; the thesis has no lens.

The lens is COLMAP's SIMPLE_RADIAL: x_d = x_u (1 + k1 r_u^2) about the optical center, r_u in focal lengths. While the
focal is sought, the parameter of the lens is kappa = k1 / f^2, with f and lengths in longer sides: the displacement of
a point of the photo must not depend on the focal that is tried.
"""

import numpy as np
from numpy.typing import NDArray

from sfm_app.jit import kernel

FloatArray = NDArray[np.float64]

LOG_FOCAL, CENTER_U, CENTER_V, LOG_ASPECT, KAPPA = range(5)
"""Places in the parameters of a camera: log f with f = sqrt(fx fy), center from the middle, log fy/fx, kappa."""
LEAST_SLOPE = 0.2
"""Least slope of the distorted over the undistorted radius; beyond it the lens continues linearly, so that it does not
fold. Chosen by hand; halved and doubled by `benchmarks.sensitivity`."""
NEWTON_STEPS = 20
"""Most steps; three or four are enough except for the strongest pincushions. Chosen by hand; halved and doubled by
`benchmarks.sensitivity`."""


@kernel
def write_camera(theta: FloatArray, camera: FloatArray) -> None:
    """Write fx, fy, u, v, k1 of a camera.

    Args:
        theta: (5,) log f, u, v, log a, kappa.
        camera: (5,), written to.
    """
    f, half = np.exp(theta[0]), np.exp(0.5 * theta[3])
    camera[0], camera[1], camera[2], camera[3] = f / half, f * half, theta[1], theta[2]
    camera[4] = theta[4] * f * f


@kernel
def undistort_radius(radius: float, k1: float, guess: float) -> float:
    """Return the undistorted radius r_u of a distorted one, in focal lengths, by Newton's method.

    Args:
        radius: r_d in focal lengths, >= 0.
        k1: of the lens.
        guess: r_u to start from.
    """
    if k1 == 0.0 or radius < 1e-9:
        return radius
    if k1 < 0.0:
        last = np.sqrt((LEAST_SLOPE - 1.0) / (3.0 * k1))
        beyond = radius - last * (1.0 + k1 * last * last)
        if beyond >= 0.0:
            return float(last + beyond / LEAST_SLOPE)
    r = guess
    for _ in range(NEWTON_STEPS):
        slope = max(1.0 + 3.0 * k1 * r * r, LEAST_SLOPE)
        step = (r * (1.0 + k1 * r * r) - radius) / slope
        r -= step
        if abs(step) < 1e-13:
            break
    return r


@kernel
def write_ray(x: float, y: float, camera: FloatArray, guess: float, out: FloatArray) -> None:
    """Write the point (a, b) of the plane z = 1 that a pixel sees, its derivatives, and r_u.

    Args:
        x: column of the pixel, in the units of the camera.
        y: row of the pixel, in the units of the camera.
        camera: (5,) fx, fy, u, v, k1.
        guess: r_u of a similar camera, to start from; negative for none.
        out: (7,), written to: a, b, da/dx, da/dy, db/dx, db/dy, r_u.
    """
    a, b = (x - camera[2]) / camera[0], (y - camera[3]) / camera[1]
    r2 = a * a + b * b
    radius, k1 = np.sqrt(r2), camera[4]
    if guess < 0.0:
        guess = radius / (1.0 + k1 * r2) if k1 > 0.0 else radius
    r = undistort_radius(radius, k1, guess)
    along = r / radius if radius > 1e-9 else 1.0
    radial = 1.0 / max(1.0 + 3.0 * k1 * r * r, LEAST_SLOPE)
    bend = (radial - along) / r2 if r2 > 1e-18 else 0.0
    out[0], out[1] = along * a, along * b
    out[2], out[3] = (along + bend * a * a) / camera[0], bend * a * b / camera[1]
    out[4], out[5] = bend * a * b / camera[0], (along + bend * b * b) / camera[1]
    out[6] = r


@kernel
def undistort_kernel(points: FloatArray, theta: FloatArray) -> FloatArray:
    """Return (N, 2) undistorted points.

    Args:
        points: (N, 2) from the middle of the photo.
        theta: (5,) parameters of the camera, in the same units.
    """
    camera, out, straight = np.empty(5), np.empty(7), np.empty_like(points)
    write_camera(theta, camera)
    for i in range(len(points)):
        write_ray(points[i, 0], points[i, 1], camera, -1.0, out)
        straight[i, 0] = out[0] * camera[0] + camera[2]
        straight[i, 1] = out[1] * camera[1] + camera[3]
    return straight
