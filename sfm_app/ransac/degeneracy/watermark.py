"""Matches that stay in place while the scene moves: logos, time stamps, dust, or the same photo twice.

Ours; the name is COLMAP's.

A logo agrees with F = [t]x for any t, so that enough of its matches make the camera appear not to rotate. A scene may
also stay in place in the image, such as an object that the photographer kept in the middle. A logo differs by its peak:
displacements of a scene vary smoothly with depth and position, and are 0 no more often than any value near 0.
"""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from sfm_app.ransac.scoring.robust_costs import squared_distances
from sfm_app.settings import EpipolarSettings
from sfm_app.types import EpipolarFit, Rejected

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]
Fit = Callable[[FloatArray, FloatArray, EpipolarSettings, int], EpipolarFit | Rejected]

SAME_PHOTO = "the same photo twice, or nearly"
ONLY_A_LOGO = "nothing in common but a logo or time stamp"

PEAK, STATIONARY, RING = 1.0, 2.0, 4.0
"""Largest displacements at the peak, of stationary matches, and of the ring around the peak, in units of keypoint
noise. Checked on the real photo sets, where they affect one pair of 456 (docs/algorithms.md, All estimators)."""
LEAST_PEAK = 8
"""Least number of matches at the peak; fewer are left to the estimator. Chosen by hand; halved and doubled by
`benchmarks.sensitivity`."""
MOST_LOST = 0.2
"""Share of the stationary matches, or of the others, that may be removed from the scene with a logo.
docs/algorithms.md, All estimators. Chosen by hand; halved and doubled by `benchmarks.sensitivity`."""
CELLS, WIDE_SHARE = 8, 0.25
"""Cells of the photo along each side, and the share of the cells with keypoints that a logo does not exceed. Chosen by
hand; halved and doubled by `benchmarks.sensitivity`."""
EXPLAINED_SHARE = 0.9
"""Share of the stationary matches that a motion without rotation explains. Chosen by hand; halved and doubled by
`benchmarks.sensitivity`."""


def find_stationary(x1: FloatArray, x2: FloatArray, unit_px: float = 1.0) -> BoolArray:
    """Find the matches that stay in place although the others move, or because nothing moves at all.

    The displacements of a scene are spread along a curve or over an area around 0: between one and four units there are
    at least three times as many as below one. Matches count as stationary where the peak holds no fewer than that
    ring, and where few matches of the scene are lost: video frames in which all move by a few pixels keep theirs.

    Args:
        x1: (N, 2) pixels.
        x2: (N, 2) pixels in a photo of the same size.
        unit_px: generous noise of the keypoints; more than 1 where they were found in a smaller image.

    Returns:
        (N,) mask; all False where there is no such peak.
    """
    squared = np.square(x2 - x1).sum(axis=1) / unit_px**2
    peak, held, reached = (int(np.count_nonzero(squared <= steps**2)) for steps in (PEAK, STATIONARY, RING))
    ring = reached - peak
    # of a scene on a line through 0, each unit of displacement holds a third of the ring
    lost = ring * STATIONARY / (RING - PEAK)
    is_peak = peak >= max(LEAST_PEAK, ring) and lost <= MOST_LOST * max(held, len(x1) - held)
    return squared <= STATIONARY**2 if is_peak else np.zeros(len(x1), bool)


def is_widespread(points: FloatArray, keypoints: FloatArray, size: tuple[int, int]) -> bool:
    """Return whether points are spread over a large part of a photo.

    Args:
        points: (N, 2) pixels.
        keypoints: (M, 2) pixels of all keypoints of the photo.
        size: (width, height) of the photo in pixels.
    """
    return len(_occupied_cells(points, size)) > WIDE_SHARE * len(_occupied_cells(keypoints, size))


def fit_moving(
    fit: Fit, points: tuple[FloatArray, FloatArray], stationary: BoolArray, wide: bool, options: EpipolarSettings,
    seed: int,
) -> EpipolarFit | Rejected:  # fmt: skip
    """Estimate the epipolar geometry of the moving matches; the stationary ones are no inliers and have prior 0.

    Where the camera moved without rotation, distant objects stay in place, too: stationary matches all over the photo
    that agree with the geometry of the others belong to the scene, and all matches are fitted together.

    Args:
        fit: the estimator.
        points: x1, x2, each (N, 2) pixels.
        stationary: (N,) mask from `find_stationary`.
        wide: whether these lie all over the photo, see `watermark.is_widespread`.
        options: settings of the estimator.
        seed: seed of the estimator.

    Returns:
        A fit whose inliers and priors are (N,); or, where the moving matches have no fit, the kind of stationary ones.
    """
    x1, x2 = points
    found = fit(x1[~stationary], x2[~stationary], options, seed)
    if not isinstance(found, EpipolarFit):
        return Rejected(SAME_PHOTO if wide else ONLY_A_LOGO)
    if wide and not found.degeneracy:
        still = np.asfortranarray(np.hstack([x1[stationary], x2[stationary]]))
        agreeing = squared_distances(still, np.ascontiguousarray(found.F).reshape(9)) <= options.max_error_px**2
        if agreeing.mean() >= EXPLAINED_SHARE:
            return fit(x1, x2, options, seed)
    inliers, priors = np.zeros(len(x1), bool), np.zeros(len(x1))
    inliers[~stationary], priors[~stationary] = found.inliers, found.priors
    return EpipolarFit(found.F, inliers, priors, found.trials, found.rms_px, found.degeneracy)


def one_per_cell(points: FloatArray, size: tuple[int, int]) -> FloatArray:
    """Return (C, 2) one point of each cell of a photo that has any; `is_widespread` needs no more of all keypoints.

    Args:
        points: (N, 2) pixels.
        size: (width, height) of the photo in pixels.
    """
    return points[np.unique(_cells(points, size), return_index=True)[1]]


def _occupied_cells(points: FloatArray, size: tuple[int, int]) -> NDArray[np.int64]:
    return np.unique(_cells(points, size))


def _cells(points: FloatArray, size: tuple[int, int]) -> NDArray[np.int64]:
    """Return (N,) the number of the cell of each point."""
    columns, rows = (points / size * CELLS).astype(np.int64).clip(0, CELLS - 1).T
    return np.asarray(CELLS * rows + columns)
