"""Outlier views, which show something other than the surface: passers-by, cars, leaves, reflections.

Where at least three photos see a triangle, a color far from their median is not the surface's. A single triangle may
deviate by chance, but a person covers many triangles, so deviations are averaged over neighbors.
After Sinha et al. 2008 and Waechter et al. 2014 (section 3.1), with medians in place of their Gaussian.
"""

import numpy as np
from numpy.typing import NDArray

from sfm_app.jit import kernel
from sfm_app.texture.appearance.median import median
from sfm_app.texture.facets import NONE, IntArray

LEAST_VIEWS = 3
"""If only two photos disagree, it is unknown which of them is right."""
LEVELS = 10.0
"""Normal difference between colors of one triangle, in gray levels."""
OUTLIER_FACTOR = 3.0
"""Deviation beyond which a photo is left out, relative to the usual deviation of a triangle."""
ROUNDS = 4
"""Rounds of averaging over neighbors: about the number of adjacent triangles that make an outlier."""


def outlier_mask(
    colors: NDArray[np.uint8], gains: NDArray[np.float64], seen: NDArray[np.bool_], neighbors: IntArray
) -> NDArray[np.bool_]:
    """Mark photos at the triangles where they show something other than the surface.

    Args:
        colors: (P, T, 3) RGB of the triangles in the photos.
        gains: (P, 3) of the photos.
        seen: (P, T) whether a photo sees a triangle.
        neighbors: (T, 3) triangles beside each triangle, -1 for none.

    Returns:
        (P, T), True only where seen.
    """
    score = np.zeros(seen.shape, np.float32)
    _deviations(colors, 1.0 / gains, seen, score)
    found = np.zeros(seen.shape, np.bool_)
    for photo in range(len(seen)):
        smooth = score[photo].copy()
        for _ in range(ROUNDS):
            before = smooth.copy()
            _average(before, seen[photo], neighbors, smooth)
        _mark(smooth, seen[photo], neighbors, found[photo])
    found &= seen.sum(axis=0) >= LEAST_VIEWS
    _keep_majority(found, seen)
    return found


@kernel
def _deviations(
    colors: NDArray[np.uint8],
    scale: NDArray[np.float64],
    seen: NDArray[np.bool_],
    score: NDArray[np.float32],
) -> None:
    """Write the largest deviation from the median color over all channels, divided by the usual deviation."""
    photos, triangles = seen.shape
    level, far = np.empty(photos), np.empty(photos)
    for f in range(triangles):
        count = 0
        for p in range(photos):
            far[p] = 0.0
            count += seen[p, f]
        if count < LEAST_VIEWS:
            continue
        for channel in range(3):
            count = 0
            for p in range(photos):
                if seen[p, f]:
                    level[count] = colors[p, f, channel] * scale[p, channel]
                    count += 1
            middle = median(level, count)
            for p in range(photos):
                if seen[p, f]:
                    far[p] = max(far[p], abs(colors[p, f, channel] * scale[p, channel] - middle))
        count = 0
        for p in range(photos):
            if seen[p, f]:
                level[count] = far[p]
                count += 1
        usual = LEVELS + median(level, count)
        for p in range(photos):
            if seen[p, f]:
                score[p, f] = far[p] / usual


@kernel
def _average(
    before: NDArray[np.float32], seen: NDArray[np.bool_], neighbors: IntArray, after: NDArray[np.float32]
) -> None:
    """Average over each triangle and its neighbors that the photo sees."""
    for f in range(len(before)):
        if not seen[f]:
            continue
        total, count = before[f], 1
        for k in range(3):
            g = neighbors[f, k]
            if g != NONE and seen[g]:
                total += before[g]
                count += 1
        after[f] = total / count


@kernel
def _mark(score: NDArray[np.float32], seen: NDArray[np.bool_], neighbors: IntArray, found: NDArray[np.bool_]) -> None:
    """Mark triangles that deviate, and their neighbors, which the outlier may cover in part."""
    for f in range(len(score)):
        if not seen[f]:
            continue
        found[f] = score[f] > OUTLIER_FACTOR
        for k in range(3):
            g = neighbors[f, k]
            if g != NONE and seen[g] and score[g] > OUTLIER_FACTOR:
                found[f] = True


@kernel
def _keep_majority(found: NDArray[np.bool_], seen: NDArray[np.bool_]) -> None:
    """Keep all photos of a triangle where at most half would remain: without agreement none is an outlier."""
    for f in range(found.shape[1]):
        left = total = 0
        for p in range(len(found)):
            total += seen[p, f]
            left += seen[p, f] and not found[p, f]
        if 2 * left <= total:
            for p in range(len(found)):
                found[p, f] = False
