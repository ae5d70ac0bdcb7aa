"""How alike the photos of a surface are: agreement, exposure, outliers."""

import numpy as np
from numpy.typing import NDArray

from sfm_app.geometry.least_squares import solve_positive
from sfm_app.jit import kernel
from sfm_app.texture.facets import NONE, IntArray, components, ranges
from sfm_app.texture.sightings import Sightings
from sfm_app.types.arrays import BoolArray, FloatArray

# The median of a few numbers, inside kernels.


@kernel
def median(values: NDArray[np.float64], count: int) -> float:
    """Sort the first values in place and return their median.

    It replaces NumPy's sort, which takes seconds to compile.

    Args:
        values: (N,) changed.
        count: number of first values used, 1 to N.
    """
    for k in range(1, count):
        value, at = values[k], k
        while at > 0 and values[at - 1] > value:
            values[at] = values[at - 1]
            at -= 1
        values[at] = value
    middle: float = 0.5 * (values[(count - 1) // 2] + values[count // 2])
    return middle


# Outlier views, which show something other than the surface: passers-by, cars, leaves, reflections.
#
# Where at least three photos see a triangle, a color far from their median is not the surface's. A single triangle
# may deviate by chance, but a person covers many triangles, so deviations are averaged over neighbors. After Sinha
# et al. 2008 and Waechter et al. 2014 (section 3.1), with medians in place of their Gaussian.

LEAST_VIEWS = 3
"""If only two photos disagree, it is unknown which of them is right."""
LEVELS = 10.0
"""Normal difference between colors of one triangle, in gray levels."""
OUTLIER_FACTOR = 3.0
"""Deviation beyond which a photo is left out, relative to the usual deviation of a triangle."""
OUTLIER_ROUNDS = 4
"""Rounds of averaging over neighbors: about the number of adjacent triangles that make an outlier."""


def outlier_mask(seen: Sightings, gains: NDArray[np.float64], neighbors: IntArray) -> NDArray[np.bool_]:
    """Mark photos at the triangles where they show something other than the surface.

    Args:
        seen: which photos see which triangles, in which colors.
        gains: (P, 3) of the photos.
        neighbors: (T, 3) triangles beside each triangle, -1 for none.

    Returns:
        (N,) for each of the views.
    """
    score = np.zeros(len(seen.face), np.float32)
    _deviations(seen.face_starts, seen.face_rows, seen.colors, seen.photo, 1.0 / gains, score)
    found = np.zeros(len(seen.face), np.bool_)
    row_of = np.full(seen.triangles, NONE, np.int64)
    for photo in range(seen.photos):
        rows = seen.rows(photo)
        face = seen.face[rows]
        row_of[face] = np.arange(len(face))
        across = neighbors[face]
        beside = np.where(across == NONE, NONE, row_of[across])
        row_of[face] = NONE
        smooth = score[rows].copy()
        for _ in range(OUTLIER_ROUNDS):
            before = smooth.copy()
            _average_beside(before, beside, smooth)
        _mark(smooth, beside, found[rows])
    found &= np.diff(seen.face_starts)[seen.face] >= LEAST_VIEWS
    _keep_majority(seen.face_starts, seen.face_rows, found)
    return found


@kernel
def measure_deviations(
    here: NDArray[np.int64],
    colors: NDArray[np.uint8],
    photo: IntArray,
    scale: NDArray[np.float64],
    level: NDArray[np.float64],
    far: NDArray[np.float64],
) -> None:
    """Write the largest deviations over the channels from the median color of a triangle.

    Args:
        here: (K,) rows of its views.
        colors: (N, 3) RGB of all views.
        photo: (N,) of all views.
        scale: (P, 3) by which the colors of each photo are multiplied.
        level: (K or more,) changed.
        far: (K or more,) the deviations in gray levels.
    """
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
    starts: NDArray[np.int64],
    rows: NDArray[np.int64],
    colors: NDArray[np.uint8],
    photo: IntArray,
    scale: NDArray[np.float64],
    score: NDArray[np.float32],
) -> None:
    """Write the largest deviation from the median color over all channels, divided by the usual deviation."""
    level, far = np.empty(len(scale)), np.empty(len(scale))
    for f in range(len(starts) - 1):
        here = rows[starts[f] : starts[f + 1]]
        count = len(here)
        if count < LEAST_VIEWS:
            continue
        measure_deviations(here, colors, photo, scale, level, far)
        for k in range(count):
            level[k] = far[k]
        usual = LEVELS + median(level, count)
        for k in range(count):
            score[here[k]] = far[k] / usual


@kernel
def _average_beside(before: NDArray[np.float32], beside: NDArray[np.int64], after: NDArray[np.float32]) -> None:
    """Average over each triangle and its neighbors that the photo sees."""
    for f in range(len(before)):
        total, count = before[f], 1
        for k in range(3):
            g = beside[f, k]
            if g != NONE:
                total += before[g]
                count += 1
        after[f] = total / count


@kernel
def _mark(score: NDArray[np.float32], beside: NDArray[np.int64], found: NDArray[np.bool_]) -> None:
    """Mark triangles that deviate, and their neighbors, which the outlier may cover in part."""
    for f in range(len(score)):
        found[f] = score[f] > OUTLIER_FACTOR
        for k in range(3):
            g = beside[f, k]
            if g != NONE and score[g] > OUTLIER_FACTOR:
                found[f] = True


@kernel
def _keep_majority(starts: NDArray[np.int64], rows: NDArray[np.int64], found: NDArray[np.bool_]) -> None:
    """Keep all photos of a triangle where at most half would remain: without agreement none is an outlier."""
    for f in range(len(starts) - 1):
        left, total = 0, starts[f + 1] - starts[f]
        for row in rows[starts[f] : starts[f + 1]]:
            left += not found[row]
        if 2 * left <= total:
            for row in rows[starts[f] : starts[f + 1]]:
                found[row] = False


# Borders of a surface where photos disagree about its color: there is no surface, each shows what lies behind.
#
# Depth maps reach over the outlines of things, by the same pixels in every photo, so that they agree with each
# other. But behind the outline each photo shows another part of the background.

DOUBTFUL = 5.0
"""Disagreement of a doubtful triangle, in medians of all triangles. Chosen with `RINGS` and `SMOOTHING` on fountain-P11
and Herz-Jesus-P8, by photos that are left out, and on `railing`, whose rods are thin: 3.5 gains a tenth of a dB on both
sets, and cuts a sixth of the rods instead of a twentieth. Left out: castle-P19, `ornament`, `garden`."""
RINGS = 20
"""Most rings of triangles that are cut from the border: what photos see of a hedge or of water stays."""
SMOOTHING = 2
"""Rounds of averaging the disagreement over neighbors, and of straightening the cut."""
PASSERS_BY = 1
"""Most photos that may show something before the surface instead of it; where more are outliers, they have a say.
Chosen by hand: people move on."""
CRUMBS = 20
"""Parts with fewer triangles go with the border that held them. Chosen on `railing`: with 200, pieces of rods go."""


def doubtful_border(seen: Sightings, gains: FloatArray, neighbors: IntArray) -> BoolArray:
    """Mark triangles to cut from the border, (T,): photos disagree about them more than about the surface elsewhere.

    Args:
        seen: which photos see which triangles, in which colors; the worth of outliers is negative.
        gains: (P, 3) of the photos.
        neighbors: (T, 3) triangles beside each triangle, -1 for none.
    """
    disagreement = np.full(seen.triangles, np.nan)
    _disagreement(seen.face_starts, seen.face_rows, seen.worth, seen.colors, seen.photo, 1.0 / gains, disagreement)
    if not np.isfinite(disagreement).any():
        return np.zeros(seen.triangles, np.bool_)
    usual = float(np.nanmedian(disagreement))
    for _ in range(SMOOTHING):
        disagreement = _average_known(disagreement, neighbors)
    doubtful = disagreement > max(DOUBTFUL * usual, LEVELS)
    cut = _straighten(_reach(doubtful, neighbors), neighbors)
    return cut | _crumbs(cut, neighbors)


@kernel
def _disagreement(
    starts: NDArray[np.int64], rows: NDArray[np.int64], worth: NDArray[np.float32], colors: NDArray[np.uint8],
    photo: IntArray, scale: FloatArray, found: FloatArray,
) -> None:  # fmt: skip
    """Write the mean deviation of the views of each triangle from their median color, in gray levels."""
    level, far, used = np.empty(len(scale)), np.empty(len(scale)), np.empty(len(scale), np.int64)
    for f in range(len(starts) - 1):
        count = strange = 0
        for row in rows[starts[f] : starts[f + 1]]:
            strange += worth[row] < 0
        for row in rows[starts[f] : starts[f + 1]]:
            if worth[row] > 0 or strange > PASSERS_BY:
                used[count] = row
                count += 1
        if count < 2:
            continue
        measure_deviations(used[:count], colors, photo, scale, level, far)
        found[f] = 0.0
        for k in range(count):
            found[f] += far[k] / count


def _average_known(values: FloatArray, neighbors: IntArray) -> FloatArray:
    """Return (T,) means over each triangle and its neighbors, of those that have a value."""
    known = np.isfinite(values)
    total, count = np.where(known, values, 0.0), known.astype(np.float64)
    for beside in neighbors.T:
        there = (beside != NONE) & known[beside]
        total += np.where(there, values[beside], 0.0)
        count += there
    return np.asarray(np.divide(total, count, out=np.full(len(values), np.nan), where=count > 0))


def _reach(doubtful: BoolArray, neighbors: IntArray) -> BoolArray:
    """Return (T,) the doubtful triangles that are connected with the border by others, within some rings."""
    front = doubtful & (neighbors == NONE).any(axis=1)
    found = front.copy()
    for _ in range(RINGS):
        beside = neighbors[front]
        near = np.zeros(len(found), np.bool_)
        near[beside[beside != NONE]] = True
        front = near & doubtful & ~found
        found |= front
    return np.asarray(found, np.bool_)


def _straighten(cut: BoolArray, neighbors: IntArray) -> BoolArray:
    """Return (T,) the cut with triangles that would stay as spikes: two of their sides would be open."""
    cut = cut.copy()
    for _ in range(SMOOTHING):
        beside = (neighbors != NONE) & cut[neighbors]
        is_open = beside | (neighbors == NONE)
        cut |= beside.any(axis=1) & (is_open.sum(axis=1) >= 2)
    return np.asarray(cut, np.bool_)


def _crumbs(cut: BoolArray, neighbors: IntArray) -> BoolArray:
    """Mark (T,) small connected parts that touch the cut."""
    part, count = components(np.where(cut, NONE, 0), neighbors)
    beside_cut = ~cut & ((neighbors != NONE) & cut[neighbors]).any(axis=1)
    crumb = np.bincount(part[~cut], minlength=count) < CRUMBS
    crumb &= np.bincount(part[beside_cut], minlength=count) > 0
    return np.asarray(~cut & crumb[part], np.bool_)


# Exposure and white balance of the photos, from triangles that several of them see.
#
# Each photo multiplies every channel by a gain: log c[f, p] = log a[f] + g[p] + noise, for triangle f and photo p.
# The colors a of the surface are eliminated, the gains g come from iteratively reweighted least squares (Cauchy),
# so that shadows, highlights and passers-by have little weight.

SAMPLES = 30_000
"""Approximate number of sampled triangles, evenly spaced."""
SAMPLES_PER_PHOTO = 100
"""Triangles for each photo of a large set. Chosen by hand: a third of what each of a hundred photos has."""
DARKEST, BRIGHTEST = 8, 247
"""Gray levels outside this range are nearly clipped and do not determine the gain."""
NOISE = 0.05
"""Scale of the Cauchy weights, in log colors; larger deviations are downweighted."""
EXPOSURE_ROUNDS = 15
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
    for _ in range(EXPOSURE_ROUNDS):
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
