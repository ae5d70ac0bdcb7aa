"""Matches that do not determine F: all on one plane, or taken without moving the camera.

What tells a real epipole is matches off the dominant plane (see `planes`), more of them than accident gives.
"""

import numpy as np
from numpy.typing import NDArray

from sfm_app.ransac.chance import MOST_FALSE_ALARMS, accidental_share, false_alarms
from sfm_app.ransac.planes import dominant_homography, transfer_distance

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

_PARALLAX_SAMPLE = 2
_PARALLAX = 2.0
"""A match is off the plane when H misses it by more than this many thresholds."""
_FOCALS = np.geomspace(0.4, 6.0, 60)
"""Focal lengths that are tried for a rotation, in sides of the box around all points."""
_ROTATION_TOLERANCE = 0.05
"""A rotation stretches nothing; a homography that stretches less than this, for some focal length, counts as one."""


def find_degeneracy(
    points: FloatArray, F: FloatArray, inliers: BoolArray, wrong: FloatArray, threshold: float, centres: FloatArray
) -> str:
    """What leaves F undetermined.

    Args:
        points: (N, 4) matches in random order.
        F: (3, 3) the model.
        inliers: (N,) at least 3 of them.
        wrong: (M,) squared distances of mismatches to F, from `chance.squared_mismatches`.
        threshold: largest distance of an inlier.
        centres: (4,) the origin of `points` in a frame that both views share, in the same units.

    Returns:
        "rotation" where the camera only turned, "planar" where all matches lie on one plane (or too close to one to
        tell), "" where F is determined.
    """
    H = dominant_homography(np.asfortranarray(points[inliers]), F, threshold)
    off_plane = transfer_distance(H, points) > _PARALLAX * threshold
    agreeing, chance = int(np.count_nonzero(off_plane & inliers)), accidental_share(wrong, threshold)
    if false_alarms(int(np.count_nonzero(off_plane)), agreeing, _PARALLAX_SAMPLE, chance) <= MOST_FALSE_ALARMS:
        return ""
    return "rotation" if is_rotation(H, points, centres) else "planar"


def is_rotation(H: FloatArray, points: FloatArray, centres: FloatArray) -> bool:
    """Whether H = K R K^-1 for one focal length and an optical centre in the middle of where both views have points."""
    placed = points + centres
    both = np.vstack([placed[:, :2], placed[:, 2:]])
    low, high = both.min(axis=0), both.max(axis=0)
    middle, side = (low + high) / 2, float((high - low).max())
    to1, to2 = _shift(middle - centres[:2]), _shift(centres[2:] - middle)
    for focal in _FOCALS * side:
        K = np.diag([focal, focal, 1.0])
        stretch = np.linalg.svd(np.linalg.inv(K) @ to2 @ H @ to1 @ K, compute_uv=False)
        if stretch[0] <= (1 + _ROTATION_TOLERANCE) * stretch[2]:
            return True
    return False


def _shift(by: FloatArray) -> FloatArray:
    return np.array([[1, 0, by[0]], [0, 1, by[1]], [0, 0, 1]], dtype=np.float64)
