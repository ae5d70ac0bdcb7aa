"""Cost of the matches of photo pairs over cameras and poses: Sampson distances of E = [t]x R, and derivatives.

A pair has fifteen parameters: five of each camera (`lens`), and the five of its relative pose. The distance of a match
is Sampson's, in pixels of the photo as it is, so that undistorting does not change the weight of a pixel::

    r = C / |dC/d(x1, y1, x2, y2)|,      C = q2' E q1,      q = ray of a pixel

That is Eq. 4.2 of the thesis for rays, with E of Eq. 5.7; adjusting cameras by it is ours. Matches that fit badly are
downweighted by the cost r^2 / (1 + r^2 / c^2) with c = 3 sigma (Geman and McClure 1987).
"""

import numpy as np
from numpy.typing import NDArray

from sfm_app.geometry.pose_manifold import POSE_DOF, retract, write_essential
from sfm_app.jit import kernel
from sfm_app.selfcal.lens import write_camera, write_ray

FloatArray = NDArray[np.float64]
IndexArray = NDArray[np.int64]

CAMERA = 5
"""Parameters of one camera. Counted: log f, u, v, log a, kappa, by definition in `lens`."""
PAIR = 2 * CAMERA + POSE_DOF
"""Parameters of a pair: two cameras and a pose, by definition."""
ROBUST_SCALE = 3.0
"""c of the robust cost, in sigma. docs/algorithms.md, Self-calibration, 2. Chosen by hand; halved and doubled by
`benchmarks.sensitivity`."""
OVERFLOW_LIMIT = 1e60
"""Squared distances in sigma^2, or derivatives, above this count as not finite. Its square is finite in double
precision."""
_STEP = 1e-6
"""Step of the parameters for finite differences: curvature causes a relative error of about 1e-6, rounding in double
precision 1e-10. Chosen by hand; halved and doubled by `benchmarks.sensitivity`."""


@kernel
def _distance(p: FloatArray, q: FloatArray, E: FloatArray) -> float:
    """Return the distance r of the rays p of view 1 and q of view 2, each (7,) as `lens.write_ray` writes it."""
    l0 = E[0, 0] * p[0] + E[0, 1] * p[1] + E[0, 2]
    l1 = E[1, 0] * p[0] + E[1, 1] * p[1] + E[1, 2]
    l2 = E[2, 0] * p[0] + E[2, 1] * p[1] + E[2, 2]
    k0 = E[0, 0] * q[0] + E[1, 0] * q[1] + E[2, 0]
    k1 = E[0, 1] * q[0] + E[1, 1] * q[1] + E[2, 1]
    g0, g1 = p[2] * k0 + p[4] * k1, p[3] * k0 + p[5] * k1
    h0, h1 = q[2] * l0 + q[4] * l1, q[3] * l0 + q[5] * l1
    return float((q[0] * l0 + q[1] * l1 + l2) / np.sqrt(g0 * g0 + g1 * g1 + h0 * h0 + h1 * h1 + 1e-300))


@kernel
def distances(
    matches: FloatArray, ends: IndexArray, thetas: FloatArray, cameras: IndexArray, poses: FloatArray
) -> FloatArray:
    """Return (M,) signed Sampson distances, in the units of the matches.

    Args:
        matches: (M, 4) of all pairs, one after the other.
        ends: (P + 1,) where each pair begins, and the end of the last.
        thetas: (C, 5) parameters of the cameras.
        cameras, poses: (P, 2) camera of view 1 and of view 2; (P, 12), see `write_essential`.
    """
    E, first, second = np.empty((3, 3)), np.empty(5), np.empty(5)
    p, q = np.empty(7), np.empty(7)
    found = np.empty(len(matches))
    for k in range(len(poses)):
        write_essential(poses[k], E)
        write_camera(thetas[cameras[k, 0]], first)
        write_camera(thetas[cameras[k, 1]], second)
        for i in range(ends[k], ends[k + 1]):
            write_ray(matches[i, 0], matches[i, 1], first, -1.0, p)
            write_ray(matches[i, 2], matches[i, 3], second, -1.0, q)
            found[i] = _distance(p, q, E)
    return found


@kernel
def pair_costs(
    matches: FloatArray, ends: IndexArray, thetas: FloatArray, cameras: IndexArray, poses: FloatArray, sigma: float
) -> FloatArray:
    """Return (P,) half the sum over the matches of a pair of their robust squared distances, in sigma^2.

    Args:
        matches: (M, 4) of all pairs, one after the other.
        ends: (P + 1,) where each pair begins, and the end of the last.
        thetas: (C, 5) parameters of the cameras.
        cameras: (P, 2) camera of view 1 and of view 2.
        poses: (P, 12), see `write_essential`.
        sigma: standard deviation of a distance, in the units of the matches.
    """
    found = distances(matches, ends, thetas, cameras, poses)
    costs = np.zeros(len(poses))
    for k in range(len(poses)):
        for i in range(ends[k], ends[k + 1]):
            r2 = (found[i] / sigma) ** 2
            costs[k] += 0.5 * r2 / (1.0 + r2 / ROBUST_SCALE**2) if r2 < OVERFLOW_LIMIT else 0.5 * ROBUST_SCALE**2
    return costs


@kernel
def pair_systems(
    matches: FloatArray, ends: IndexArray, thetas: FloatArray, cameras: IndexArray, poses: FloatArray, sigma: float
) -> tuple[FloatArray, FloatArray]:
    """Return Gauss-Newton systems of all pairs in their fifteen parameters: camera 1, camera 2, pose.

    Args:
        matches: (M, 4) of all pairs, one after the other.
        ends: (P + 1,) where each pair begins, and the end of the last.
        thetas: (C, 5) parameters of the cameras.
        cameras: (P, 2) camera of view 1 and of view 2.
        poses: (P, 12), see `write_essential`.
        sigma: standard deviation of a distance, in the units of the matches.

    Returns:
        (P, 15, 15) approximate Hessians of the costs and (P, 15) their negative gradients; where both views are of one
        camera, all of its entries are in the first five rows and columns.
    """
    A, b = np.zeros((len(poses), PAIR, PAIR)), np.zeros((len(poses), PAIR))
    # derivatives are finite differences: index 0 is unchanged, 1 to 5 have one parameter moved
    lenses, Es = np.empty((2, 1 + CAMERA, 5)), np.empty((1 + POSE_DOF, 3, 3))
    rays, J = np.empty((2, 1 + CAMERA, 7)), np.empty(PAIR)
    for k in range(len(poses)):
        shared = cameras[k, 0] == cameras[k, 1]
        J[:] = 0.0
        _write_poses(poses[k], Es)
        for view in range(2):
            _write_cameras(thetas[cameras[k, view]], lenses[view])
        for i in range(ends[k], ends[k + 1]):
            for view in range(2):
                _write_rays(matches[i, 2 * view], matches[i, 2 * view + 1], lenses[view], rays[view])
            r = _write_derivatives(rays, Es, sigma, shared, J)
            if _is_finite(r, J):
                _add_match(A[k], b[k], J, r, (1.0 + r * r / ROBUST_SCALE**2) ** -2)
        _mirror(A[k])
    return A, b


@kernel
def _write_poses(pose: FloatArray, Es: FloatArray) -> None:
    """Write E of a pose, and with each of its five parameters moved, into `Es` (6, 3, 3)."""
    step = np.zeros(POSE_DOF)
    write_essential(pose, Es[0])
    for j in range(POSE_DOF):
        step[j] = _STEP
        write_essential(retract(pose, step), Es[1 + j])
        step[j] = 0.0


@kernel
def _write_cameras(theta: FloatArray, lenses: FloatArray) -> None:
    """Write the camera of the parameters (5,), and with each of them moved, into `lenses` (6, 5)."""
    trial = theta.copy()
    write_camera(trial, lenses[0])
    for j in range(CAMERA):
        kept = trial[j]
        trial[j] = kept + _STEP
        write_camera(trial, lenses[1 + j])
        trial[j] = kept


@kernel
def _write_rays(x: float, y: float, lenses: FloatArray, rays: FloatArray) -> None:
    """Write the ray of a pixel through each of `lenses` (6, 5) into `rays` (6, 7); the first initializes the others."""
    guess = -1.0
    for j in range(1 + CAMERA):
        write_ray(x, y, lenses[j], guess, rays[j])
        guess = rays[0, 6]


@kernel
def _write_derivatives(rays: FloatArray, Es: FloatArray, sigma: float, shared: bool, J: FloatArray) -> float:
    """Return the distance r of one match in sigma, and write dr over the fifteen parameters into `J` (15,).

    Args:
        rays: (2, 6, 7) from `_write_rays`, per view.
        Es: (6, 3, 3) from `_write_poses`.
        sigma: standard deviation of a distance.
        shared: whether both views are of one camera: then both rays move with its parameters, in the first five.
        J: filled; where shared, 5 to 9 stay as they are.
    """
    r = _distance(rays[0, 0], rays[1, 0], Es[0]) / sigma
    for j in range(CAMERA):
        if shared:
            J[j] = (_distance(rays[0, 1 + j], rays[1, 1 + j], Es[0]) / sigma - r) / _STEP
        else:
            J[j] = (_distance(rays[0, 1 + j], rays[1, 0], Es[0]) / sigma - r) / _STEP
            J[CAMERA + j] = (_distance(rays[0, 0], rays[1, 1 + j], Es[0]) / sigma - r) / _STEP
    for j in range(POSE_DOF):
        J[2 * CAMERA + j] = (_distance(rays[0, 0], rays[1, 0], Es[1 + j]) / sigma - r) / _STEP
    return float(r)


@kernel
def _is_finite(r: float, J: FloatArray) -> bool:
    """Return whether a distance and its derivatives are finite; at an epipole the gradient vanishes."""
    total = r * r
    for j in range(PAIR):
        total += abs(J[j])
    return bool(total < OVERFLOW_LIMIT)


@kernel
def _mirror(A: FloatArray) -> None:
    """Copy the lower triangle to the upper one."""
    for i in range(PAIR):
        for j in range(i):
            A[j, i] = A[i, j]


@kernel
def _add_match(A: FloatArray, b: FloatArray, J: FloatArray, r: float, weight: float) -> None:
    """Add one match: weight J'J to the lower triangle of A, -weight J'r to b."""
    for i in range(PAIR):
        scaled = weight * J[i]
        b[i] -= scaled * r
        for j in range(i + 1):
            A[i, j] += scaled * J[j]
