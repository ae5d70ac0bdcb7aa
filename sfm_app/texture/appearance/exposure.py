"""Exposure and white balance of the photos, from triangles that several of them see.

Each photo multiplies every channel by a gain: log c[f, p] = log a[f] + g[p] + noise, for triangle f and photo p. The
colors a of the surface are eliminated, the gains g come from iteratively reweighted least squares (Cauchy), so that
shadows, highlights and passers-by have little weight.
"""

import numpy as np
from numpy.typing import NDArray

from sfm_app.geometry.spd_solve import solve_positive
from sfm_app.jit import kernel
from sfm_app.texture.appearance.median import median

FloatArray = NDArray[np.float64]

SAMPLES = 30_000
"""Approximate number of sampled triangles, evenly spaced."""
DARKEST, BRIGHTEST = 8, 247
"""Gray levels outside this range are nearly clipped and do not determine the gain."""
NOISE = 0.05
"""Scale of the Cauchy weights, in log colors; larger deviations are downweighted."""
ROUNDS = 15
PRIOR = 0.01
"""Weight of "no gain", as a share of the mean weight of a photo: keeps undetermined gains at 1."""


def photo_gains(colors: NDArray[np.uint8], seen: NDArray[np.bool_]) -> FloatArray:
    """Estimate the gain of every photo and channel; the geometric mean of the gains is 1.

    Args:
        colors: (P, T, 3) RGB of the triangles in the photos.
        seen: (P, T) whether a photo sees a triangle.

    Returns:
        (P, 3) gains; dividing a photo by its gains makes it consistent with the others.
    """
    shared = np.flatnonzero(seen.sum(axis=0) > 1)
    picked = shared[:: max(1, len(shared) // SAMPLES)]
    gains = np.zeros((len(colors), 3))
    for channel in range(3):
        values = colors[:, picked, channel].T
        usable = seen[:, picked].T & (values >= DARKEST) & (values <= BRIGHTEST)
        logs = np.where(usable, np.log(np.maximum(values, 1).astype(np.float64)), 0.0)
        gains[:, channel] = _log_gains(logs, usable)
    return np.exp(gains)


def _log_gains(logs: FloatArray, usable: NDArray[np.bool_]) -> FloatArray:
    photos = logs.shape[1]
    gains = np.zeros(photos)
    for _ in range(ROUNDS):
        normal, right = np.zeros((photos, photos)), np.zeros(photos)
        _add_equations(logs, usable, gains, normal, right)
        prior = PRIOR * max(np.trace(normal) / photos, 1e-12)
        gains = solve_positive(normal + prior * np.eye(photos), right[:, None])[:, 0]
        gains -= gains.mean()
    return gains


@kernel
def _add_equations(
    logs: FloatArray, usable: NDArray[np.bool_], gains: FloatArray, normal: FloatArray, right: FloatArray
) -> None:
    """Add the normal equations of the gains at the present weights, with the color of each triangle eliminated."""
    photos = logs.shape[1]
    weight, level = np.empty(photos), np.empty(photos)
    for f in range(len(logs)):
        count = 0
        for p in range(photos):
            if usable[f, p]:
                level[count] = logs[f, p] - gains[p]
                count += 1
        if count < 2:
            continue
        middle = median(level, count)
        total = mean = 0.0
        for p in range(photos):
            weight[p] = 0.0
            if usable[f, p]:
                weight[p] = 1.0 / (1.0 + ((logs[f, p] - gains[p] - middle) / NOISE) ** 2)
                total += weight[p]
                mean += weight[p] * logs[f, p]
        mean /= total
        for p in range(photos):
            if weight[p] == 0.0:
                continue
            right[p] += weight[p] * (logs[f, p] - mean)
            normal[p, p] += weight[p]
            for q in range(photos):
                normal[p, q] -= weight[p] * weight[q] / total
