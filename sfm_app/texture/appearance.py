"""Agreement of the photos of a surface: outliers, exposure."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sfm_app.geometry.least_squares import solve_positive
from sfm_app.jit import kernel
from sfm_app.texture.sightings import NONE, IntArray, Sightings, ranges
from sfm_app.types.arrays import BoolArray, FloatArray, IndexArray

LEAST_VIEWS = 3
"""If only two photos disagree, it is unknown which of them is right."""
LEVELS = 10.0
"""Normal difference between colors of one triangle, in gray levels."""
OUTLIER_FACTOR = 3.0
"""Deviation of an outlier, relative to the median deviation of the triangle."""


@dataclass(frozen=True, slots=True)
class GainOptions:
    """Samples and weights of the exposure estimate."""

    samples: int = 30_000
    """Approximate number of sampled triangles, evenly spaced."""
    samples_per_photo: int = 100
    """Triangles per photo of a large set. Chosen by hand: a third of the value for a hundred photos."""
    darkest: int = 8
    """Darker gray levels are nearly clipped and do not determine the gain."""
    brightest: int = 247
    rounds: int = 15
    prior: float = 0.01
    """Weight of "no gain", as a share of the mean weight of a photo: keeps undetermined gains at 1."""


GAINS = GainOptions()


@kernel
def median(values: FloatArray, count: int) -> float:
    """Sort the first `count` >= 1 values in place and return their median; NumPy's sort takes seconds to compile."""
    for k in range(1, count):
        value, at = values[k], k
        while at > 0 and values[at - 1] > value:
            values[at] = values[at - 1]
            at -= 1
        values[at] = value
    middle: float = 0.5 * (values[(count - 1) // 2] + values[count // 2])
    return middle


# Outlier views, which do not show the surface: passers-by, cars, leaves, reflections.
# If at least three photos show a triangle, a color far from their median is not the surface's. A single triangle
# may deviate by chance, but a person covers many triangles, so deviations are averaged over neighbors. After Sinha
# et al. 2008 and Waechter et al. 2014 (section 3.1), with medians in place of their Gaussian.


def outlier_mask(sightings: Sightings, gains: FloatArray, neighbors: IntArray) -> BoolArray:
    """Mark outlier views (N,), given the gains (P, 3) of the photos."""
    deviation = np.zeros(len(sightings.face), np.float32)
    _deviations(sightings.face_starts, sightings.face_rows, sightings.colors, sightings.photo, 1.0 / gains, deviation)
    outlier = np.zeros(len(sightings.face), np.bool_)
    row_of = np.full(sightings.triangles, NONE, np.int64)
    for photo in range(sightings.photos):
        rows = sightings.rows(photo)
        face = sightings.face[rows]
        row_of[face] = np.arange(len(face))
        across = neighbors[face]
        beside = np.where(across == NONE, NONE, row_of[across])
        row_of[face] = NONE
        smooth = deviation[rows]
        for _ in range(4):  # about the number of adjacent triangles that make an outlier
            smooth = _average_known(smooth, beside).astype(np.float32)
        far = smooth > OUTLIER_FACTOR
        outlier[rows] = far | ((beside != NONE) & far[beside]).any(axis=1)  # it may cover neighbors in part
    views = np.diff(sightings.face_starts)
    outlier &= views[sightings.face] >= LEAST_VIEWS
    # without agreement of more than half of the photos none is an outlier
    agreeing = np.bincount(sightings.face[~outlier], minlength=sightings.triangles)
    return np.asarray(outlier & (2 * agreeing > views)[sightings.face])


@kernel
def _measure_deviations(
    here: IndexArray, colors: NDArray[np.uint8], photo: IntArray, scale: FloatArray, level: FloatArray, far: FloatArray
) -> None:
    """Write the largest deviations `far` of the views `here` from their median color; `level` is a buffer."""
    count = len(here)
    far[:count] = 0.0
    for channel in range(3):
        for k in range(count):
            level[k] = colors[here[k], channel] * scale[photo[here[k]], channel]
        middle = median(level, count)
        for k in range(count):
            far[k] = max(far[k], abs(colors[here[k], channel] * scale[photo[here[k]], channel] - middle))


@kernel
def _deviations(
    starts: IndexArray,
    rows: IndexArray,
    colors: NDArray[np.uint8],
    photo: IntArray,
    scale: FloatArray,
    deviation: NDArray[np.float32],
) -> None:
    """Write the largest deviation from the median color over all channels, relative to the median deviation."""
    level, far = np.empty(len(scale)), np.empty(len(scale))
    for f in range(len(starts) - 1):
        here = rows[starts[f] : starts[f + 1]]
        count = len(here)
        if count < LEAST_VIEWS:
            continue
        _measure_deviations(here, colors, photo, scale, level, far)
        for k in range(count):
            level[k] = far[k]
        median_far = LEVELS + median(level, count)
        for k in range(count):
            deviation[here[k]] = far[k] / median_far


def _average_known(values: NDArray[np.floating], neighbors: IntArray) -> FloatArray:
    known = np.isfinite(values)
    total, count = np.where(known, values, 0.0), known.astype(np.float64)
    for beside in neighbors.T:
        usable = (beside != NONE) & known[beside]
        total += np.where(usable, values[beside], 0.0)
        count += usable
    return np.asarray(np.divide(total, count, out=np.full(len(values), np.nan), where=count > 0))


# Exposure and white balance of the photos, from triangles in several of them.
# Each photo multiplies every channel by a gain: log c[f, p] = log a[f] + g[p] + noise, for triangle f and photo p.
# The colors a of the surface are eliminated, the gains g come from iteratively reweighted least squares (Cauchy),
# so that shadows, highlights and passers-by have little weight.


def photo_gains(sightings: Sightings) -> FloatArray:
    """Estimate gains (P, 3), of geometric mean 1; dividing a photo by its gains makes it consistent with the others."""
    counts = np.diff(sightings.face_starts)
    shared = np.flatnonzero(counts > 1)
    samples = max(GAINS.samples, GAINS.samples_per_photo * sightings.photos)
    picked = shared[:: max(1, len(shared) // samples)]
    rows = sightings.face_rows[ranges(sightings.face_starts[picked], sightings.face_starts[picked + 1])]
    starts = np.concatenate([[0], np.cumsum(counts[picked])]).astype(np.int64)
    photo = sightings.photo[rows].astype(np.int64)
    gains = np.zeros((sightings.photos, 3))
    for channel in range(3):
        values = sightings.colors[rows, channel]
        usable = (values >= GAINS.darkest) & (values <= GAINS.brightest)
        first = np.concatenate([[0], np.cumsum(usable)])[starts]
        gains[:, channel] = _log_gains(
            np.log(values[usable].astype(np.float64)), photo[usable], first, sightings.photos
        )
    return np.exp(gains)


def _log_gains(logs: FloatArray, photo: IndexArray, starts: IndexArray, photos: int) -> FloatArray:
    gains = np.zeros(photos)
    for _ in range(GAINS.rounds):
        normal, right = np.zeros((photos, photos)), np.zeros(photos)
        _add_equations(logs, photo, starts, gains, normal, right)
        prior = GAINS.prior * max(np.trace(normal) / photos, 1e-12)
        gains = solve_positive(normal + prior * np.eye(photos), right[:, None])[:, 0]
        gains -= gains.mean()
    return gains


@kernel
def _add_equations(
    logs: FloatArray, photo: IndexArray, starts: IndexArray, gains: FloatArray, normal: FloatArray, right: FloatArray
) -> None:
    """Add the normal equations of the gains at the current weights, with the color of each triangle eliminated."""
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
            # Cauchy weights of scale 0.05 in log colors
            weight[k] = 1.0 / (1.0 + ((logs[row] - gains[photo[row]] - middle) / 0.05) ** 2)
            total += weight[k]
            mean += weight[k] * logs[row]
        mean /= total
        for k in range(count):
            p = photo[first + k]
            right[p] += weight[k] * (logs[first + k] - mean)
            normal[p, p] += weight[k]
            for j in range(count):
                normal[p, photo[first + j]] -= weight[k] * weight[j] / total
