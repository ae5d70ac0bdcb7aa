"""Outlier views, which show something other than the surface: passers-by, cars, leaves, reflections.

Where at least three photos see a triangle, a color far from their median is not the surface's. A single triangle may
deviate by chance, but a person covers many triangles, so deviations are averaged over neighbors.
After Sinha et al. 2008 and Waechter et al. 2014 (section 3.1), with medians in place of their Gaussian.
"""

import numpy as np
from numpy.typing import NDArray

from sfm_app.jit import kernel
from sfm_app.texture.appearance.median import median
from sfm_app.texture.appearance.sightings import Sightings
from sfm_app.texture.facets import NONE, IntArray

LEAST_VIEWS = 3
"""If only two photos disagree, it is unknown which of them is right."""
LEVELS = 10.0
"""Normal difference between colors of one triangle, in gray levels."""
OUTLIER_FACTOR = 3.0
"""Deviation beyond which a photo is left out, relative to the usual deviation of a triangle."""
ROUNDS = 4
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
        for _ in range(ROUNDS):
            before = smooth.copy()
            _average(before, beside, smooth)
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
def _average(before: NDArray[np.float32], beside: NDArray[np.int64], after: NDArray[np.float32]) -> None:
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
