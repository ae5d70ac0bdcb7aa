"""Borders of a surface where photos disagree about its color: there is no surface, each shows what lies behind.

Depth maps reach over the outlines of things, by the same pixels in every photo, so that they agree with each other. But
behind the outline each photo shows another part of the background.
"""

import numpy as np
from numpy.typing import NDArray

from sfm_app.jit import kernel
from sfm_app.texture.appearance.photo_consistency import LEVELS, measure_deviations
from sfm_app.texture.appearance.sightings import Sightings
from sfm_app.texture.facets import NONE, IntArray, components

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

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
        disagreement = _average(disagreement, neighbors)
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


def _average(values: FloatArray, neighbors: IntArray) -> FloatArray:
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
