"""The five degrees of freedom of a relative pose, fitted to matches with known cameras.

F has seven parameters, a relative pose five: with K known, the other two no longer fit noise, mismatches that happen to
lie right, and repeated structure. On real photos that alone halves the error of the direction of translation.
"""

import numpy as np
from numpy.typing import NDArray

from sfm_app.geometry.damping import DECREASE, INCREASE, DampingRange
from sfm_app.geometry.pose_manifold import POSE_DOF, retract, write_essential
from sfm_app.jit import kernel

FloatArray = NDArray[np.float64]

SIGMAS_PX = (0.5, 0.2)
"""Scales of the Cauchy loss, used one after the other. Keypoints are good to about 0.2 px; with a wider scale the
mismatches that a second structure explains pull the pose to a compromise between both. docs/algorithms.md, From K to
relative poses."""
STEPS = 12
"""Largest number of steps at each scale. Chosen by hand; halved and doubled by `benchmarks.sensitivity`."""
DAMPING = DampingRange(first=1e-4, least=1e-9, most=1e6)
"""Damping of the Levenberg-Marquardt steps. Chosen by hand; halved and doubled by `benchmarks.sensitivity`."""
GAIN = 1e-6
"""Relative decrease of the cost below which they end. Chosen by hand; halved and doubled by
`benchmarks.sensitivity`."""
_DIFFERENCE_STEP = 1e-6
"""Step of the parameters for finite differences. Chosen by hand; halved and doubled by `benchmarks.sensitivity`."""


def refine_pose(lines: FloatArray, R: FloatArray, t: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Refine the pose (R, t) by robust least squares of Sampson distances (Levenberg-Marquardt).

    Args:
        lines: (N, 18) matches as bearing vectors with derivatives (`geometry.lenses.bearings`), view 1 and view 2.
        R: (3, 3) rotation of view 2 from view 1.
        t: (3,) direction of its translation.
    """
    pose = np.concatenate([R.ravel(), t / np.linalg.norm(t)])
    for sigma in SIGMAS_PX:
        pose = _descend(lines, pose, sigma)
    return pose[:9].reshape(3, 3).copy(), pose[9:].copy()


def pose_distances(lines: FloatArray, R: FloatArray, t: FloatArray) -> FloatArray:
    """Return the Sampson distances (N,) of matches to a relative pose, in pixels, >= 0.

    Args:
        lines: (N, 18) matches as bearing vectors with derivatives (`geometry.lenses.bearings`), view 1 and view 2.
        R: (3, 3) rotation of view 2 from view 1.
        t: (3,) unit vector along its translation.
    """
    pose = np.concatenate([R.ravel(), t])
    return np.abs(_distances(lines, pose))


@kernel
def _distance(line: FloatArray, E: FloatArray) -> float:
    """Return the signed distance of one match, (18,)."""
    l0 = E[0, 0] * line[0] + E[0, 1] * line[1] + E[0, 2] * line[2]
    l1 = E[1, 0] * line[0] + E[1, 1] * line[1] + E[1, 2] * line[2]
    l2 = E[2, 0] * line[0] + E[2, 1] * line[1] + E[2, 2] * line[2]
    k0 = E[0, 0] * line[9] + E[1, 0] * line[10] + E[2, 0] * line[11]
    k1 = E[0, 1] * line[9] + E[1, 1] * line[10] + E[2, 1] * line[11]
    k2 = E[0, 2] * line[9] + E[1, 2] * line[10] + E[2, 2] * line[11]
    g0 = k0 * line[3] + k1 * line[4] + k2 * line[5]
    g1 = k0 * line[6] + k1 * line[7] + k2 * line[8]
    h0 = l0 * line[12] + l1 * line[13] + l2 * line[14]
    h1 = l0 * line[15] + l1 * line[16] + l2 * line[17]
    algebraic = line[9] * l0 + line[10] * l1 + line[11] * l2
    return float(algebraic / np.sqrt(g0 * g0 + g1 * g1 + h0 * h0 + h1 * h1 + 1e-300))


@kernel
def _distances(lines: FloatArray, pose: FloatArray) -> FloatArray:
    E, found = np.empty((3, 3)), np.empty(lines.shape[0])
    write_essential(pose, E)
    for i in range(lines.shape[0]):
        found[i] = _distance(lines[i], E)
    return found


@kernel
def _cost(lines: FloatArray, pose: FloatArray, sigma: float) -> float:
    E, cost = np.empty((3, 3)), 0.0
    write_essential(pose, E)
    for i in range(lines.shape[0]):
        cost += np.log1p((_distance(lines[i], E) / sigma) ** 2)
    return cost


@kernel
def _system(lines: FloatArray, pose: FloatArray, sigma: float) -> tuple[FloatArray, FloatArray]:
    """Return the approximate Hessian (5, 5) and the negative gradient (5,) of half the cost."""
    Es, J, step = np.empty((1 + POSE_DOF, 3, 3)), np.empty(POSE_DOF), np.zeros(POSE_DOF)
    A, b = np.zeros((POSE_DOF, POSE_DOF)), np.zeros(POSE_DOF)
    write_essential(pose, Es[0])
    for j in range(POSE_DOF):
        step[j] = _DIFFERENCE_STEP
        write_essential(retract(pose, step), Es[1 + j])
        step[j] = 0.0
    for i in range(lines.shape[0]):
        r = _distance(lines[i], Es[0]) / sigma
        weight = 1.0 / (1.0 + r * r)
        for j in range(POSE_DOF):
            J[j] = (_distance(lines[i], Es[1 + j]) / sigma - r) / _DIFFERENCE_STEP
        for j in range(POSE_DOF):
            b[j] -= weight * r * J[j]
            for k in range(POSE_DOF):
                A[j, k] += weight * J[j] * J[k]
    return A, b


@kernel
def _descend(lines: FloatArray, pose: FloatArray, sigma: float) -> FloatArray:
    cost, damping = _cost(lines, pose, sigma), DAMPING.first
    for _ in range(STEPS):
        A, b = _system(lines, pose, sigma)
        before, found = cost, False
        while damping < DAMPING.most and not found:
            step = _solve(A, b, damping)
            trial = retract(pose, step)
            lower = _cost(lines, trial, sigma)
            if lower < cost:
                pose, cost, found = trial, lower, True
                damping = max(DECREASE * damping, DAMPING.least)
            else:
                damping *= INCREASE
        if not found or before - cost < GAIN * before:
            break
    return pose


@kernel
def _solve(A: FloatArray, b: FloatArray, damping: float) -> FloatArray:
    """Solve the damped system by Cholesky's decomposition."""
    L, x = np.zeros((POSE_DOF, POSE_DOF)), np.empty(POSE_DOF)
    for i in range(POSE_DOF):
        for j in range(i + 1):
            value = A[i, j]
            if i == j:
                value += damping * A[i, i] + 1e-9
            for k in range(j):
                value -= L[i, k] * L[j, k]
            L[i, j] = np.sqrt(max(value, 1e-300)) if i == j else value / L[j, j]
    for i in range(POSE_DOF):
        x[i] = b[i]
        for k in range(i):
            x[i] -= L[i, k] * x[k]
        x[i] /= L[i, i]
    for i in range(POSE_DOF - 1, -1, -1):
        for k in range(i + 1, POSE_DOF):
            x[i] -= L[k, i] * x[k]
        x[i] /= L[i, i]
    return x
