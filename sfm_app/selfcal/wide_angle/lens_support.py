"""How many matches of a pair a lens explains, by samples of eight.

Samples are scored by a truncated loss (MSAC, Torr and Zisserman 2000).
"""

import numpy as np
from numpy.typing import NDArray

from sfm_app.geometry.lenses.ray_epipolar import FIRST, SECOND, fit_rays, squared_distances

FloatArray = NDArray[np.float64]
IndexArray = NDArray[np.int64]

REFITS = 3
"""Refits to the inliers of the best sample. Chosen by hand; not measured on its own."""
MIN_INLIERS = 12
"""Fewer inliers are not refitted: eight determine F. Chosen by hand; not measured on its own."""


def search_rays(lines: FloatArray, samples: IndexArray, threshold: float) -> tuple[float, FloatArray]:
    """Return the support of the best F, in matches, and F (3, 3).

    A match counts 1 - d^2 / threshold^2, or nothing beyond the threshold.

    Args:
        lines: (N, 18) matches, as in `geometry.lenses.ray_epipolar`.
        samples: (S, 8) rows of them.
        threshold: largest distance of an inlier, in the unit of the photo, > 0.
    """
    p, q = lines[:, FIRST], lines[:, SECOND]
    Fs = fit_rays(p[samples], q[samples])
    supports = _supports(Fs, lines, threshold)
    best = int(np.argmax(supports))
    F, support = Fs[best], float(supports[best])
    for _ in range(REFITS):
        inliers = squared_distances(F[None], lines)[0] < threshold**2
        if np.count_nonzero(inliers) < MIN_INLIERS:
            break
        again = fit_rays(p[inliers], q[inliers])
        value = float(_supports(again[None], lines, threshold)[0])
        if value <= support:
            break
        F, support = again, value
    return support, F


def _supports(Fs: FloatArray, lines: FloatArray, threshold: float) -> FloatArray:
    return np.asarray(np.sum(1.0 - np.minimum(squared_distances(Fs, lines) / threshold**2, 1.0), axis=1), np.float64)
