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
from sfm_app.texture.appearance.sightings import Sightings
from sfm_app.texture.facets import ranges

FloatArray = NDArray[np.float64]

SAMPLES = 30_000
"""Approximate number of sampled triangles, evenly spaced."""
SAMPLES_PER_PHOTO = 100
"""Triangles for each photo of a large set. Chosen by hand: a third of what each of a hundred photos has."""
DARKEST, BRIGHTEST = 8, 247
"""Gray levels outside this range are nearly clipped and do not determine the gain."""
NOISE = 0.05
"""Scale of the Cauchy weights, in log colors; larger deviations are downweighted."""
ROUNDS = 15
PRIOR = 0.01
"""Weight of "no gain", as a share of the mean weight of a photo: keeps undetermined gains at 1."""


def photo_gains(seen: Sightings) -> FloatArray:
    """Estimate the gain of every photo and channel; the geometric mean of the gains is 1.

    Args:
        seen: which photos see which triangles, in which colors.

    Returns:
        (P, 3) gains; dividing a photo by its gains makes it consistent with the others.
    """
    counts = np.diff(seen.face_starts)
    shared = np.flatnonzero(counts > 1)
    samples = max(SAMPLES, SAMPLES_PER_PHOTO * seen.photos)
    picked = shared[:: max(1, len(shared) // samples)]
    rows = seen.face_rows[ranges(seen.face_starts[picked], seen.face_starts[picked + 1])]
    starts = np.concatenate([[0], np.cumsum(counts[picked])]).astype(np.int64)
    photo = seen.photo[rows].astype(np.int64)
    gains = np.zeros((seen.photos, 3))
    for channel in range(3):
        values = seen.colors[rows, channel]
        usable = (values >= DARKEST) & (values <= BRIGHTEST)
        left = np.concatenate([[0], np.cumsum(usable)])[starts]
        gains[:, channel] = _log_gains(np.log(values[usable].astype(np.float64)), photo[usable], left, seen.photos)
    return np.exp(gains)


def _log_gains(logs: FloatArray, photo: NDArray[np.int64], starts: NDArray[np.int64], photos: int) -> FloatArray:
    gains = np.zeros(photos)
    for _ in range(ROUNDS):
        normal, right = np.zeros((photos, photos)), np.zeros(photos)
        _add_equations(logs, photo, starts, gains, normal, right)
        prior = PRIOR * max(np.trace(normal) / photos, 1e-12)
        gains = solve_positive(normal + prior * np.eye(photos), right[:, None])[:, 0]
        gains -= gains.mean()
    return gains


@kernel
def _add_equations(
    logs: FloatArray,
    photo: NDArray[np.int64],
    starts: NDArray[np.int64],
    gains: FloatArray,
    normal: FloatArray,
    right: FloatArray,
) -> None:
    """Add the normal equations of the gains at the present weights, with the color of each triangle eliminated."""
    weight, level = np.empty(len(right)), np.empty(len(right))
    for f in range(len(starts) - 1):
        first, count = starts[f], starts[f + 1] - starts[f]
        if count < 2:
            continue
        for k in range(count):
            level[k] = logs[first + k] - gains[photo[first + k]]
        middle = median(level, count)
        total = mean = 0.0
        for k in range(count):
            row = first + k
            weight[k] = 1.0 / (1.0 + ((logs[row] - gains[photo[row]] - middle) / NOISE) ** 2)
            total += weight[k]
            mean += weight[k] * logs[row]
        mean /= total
        for k in range(count):
            p = photo[first + k]
            right[p] += weight[k] * (logs[first + k] - mean)
            normal[p, p] += weight[k]
            for j in range(count):
                normal[p, photo[first + j]] -= weight[k] * weight[j] / total
