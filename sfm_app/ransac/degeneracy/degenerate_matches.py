"""Matches that do not determine F: all on one line of a photo, on one plane, or from a camera that did not move.

Ours, with Hartley and Zisserman (2004), 11.9, on the parameters that a line or a plane leaves free, and Moisan and
Stival (2004) on chance.

Matches on a line of one view leave two parameters of F free, on a line of both views four. As many other matches fix
them, even mismatches: the evidence is more matches off the line than expected by chance. In the same way the evidence
for an epipole is matches off the dominant plane (see `dominant_plane`).
"""

import numpy as np
from numpy.typing import NDArray

from sfm_app.jit import kernel
from sfm_app.ransac.degeneracy.dominant_plane import OFF_PLANE, dominant_homography, transfer_distance
from sfm_app.ransac.sampling.minimal_samples import uniform
from sfm_app.ransac.verification.a_contrario import MOST_FALSE_ALARMS, accidental_share, false_alarms

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

_LINE_SAMPLE, _PARALLAX_SAMPLE = 4, 2
"""Matches that fix the parameters of F that a line, or a plane, leaves free. Counted: parameters of F
(docs/algorithms.md, All estimators)."""
_OFF_LINE = 2.0
"""Distance in thresholds beyond which a match is off the line, as for planes `dominant_plane.OFF_PLANE`. Chosen by
hand; halved and doubled by `benchmarks.sensitivity`."""
_LINES, _MOST_SCORED = 16, 300
"""Sampled lines, and the inliers that each is scored on. A relevant line holds most inliers, so few samples find it:
one of 16 pairs lies on a line that holds half of them 99 times in 100. Chosen by hand; halved and doubled by
`benchmarks.sensitivity`."""
_EXTENT_QUANTILES = (0.01, 0.99)
"""Quantiles that bound the points of a view, without a few gross outliers. Chosen by hand; halved and doubled by
`benchmarks.sensitivity`."""
_FOCALS = np.geomspace(0.4, 6.0, 60)
"""Focal lengths that are tried for a rotation, in sides of the box around the points. Chosen by hand; halved and
doubled by `benchmarks.sensitivity`."""
_LEAST_PARALLAX_SHARE = 0.05
"""Share of the inliers off the plane below which a rotation counts as one. Mismatches on rows of bricks share a
vanishing point: they agree with an epipole there far more often than by chance. On the real photo sets no pair has such
a homography and less than 40 % off it (docs/algorithms.md, All estimators)."""
_ROTATION_TOLERANCE = 0.05
"""Largest relative stretch of a homography that counts as a rotation, for some focal length; a rotation has none.
Chosen by hand; halved and doubled by `benchmarks.sensitivity`."""


def find_degeneracy(
    points: FloatArray, F: FloatArray, inliers: BoolArray, wrong: FloatArray, threshold: float, centers: FloatArray
) -> str:
    """Return the kind of degeneracy that leaves F undetermined.

    Args:
        points: (N, 4) matches in random order.
        F: (3, 3) the model.
        inliers: (N,) mask, at least 3 of them True.
        wrong: (M,) squared distances of mismatches to F, from `a_contrario.squared_mismatch_distances`.
        threshold: largest distance of an inlier.
        centers: (4,) the origin of `points` in a frame that both views share, in the same units.

    Returns:
        "collinear" where all matches lie on one line of a photo or at one point (except for a few that may be chance),
        "rotation" where the camera only rotated, "planar" where all matches lie on one plane or too close to one, ""
        where F is determined.
    """
    chance = accidental_share(wrong, threshold)
    for view in range(2):
        off_line = off_line_mask(points, inliers, view, _OFF_LINE * threshold)
        if _can_be_accident(off_line, inliers, _LINE_SAMPLE, chance):
            return "collinear"
    H = dominant_homography(np.asfortranarray(points[inliers]), F, threshold)
    off_plane = transfer_distance(H, points) > OFF_PLANE * threshold
    planar = _can_be_accident(off_plane, inliers, _PARALLAX_SAMPLE, chance)
    parallax = np.count_nonzero(off_plane & inliers) / np.count_nonzero(inliers)
    if (planar or parallax < _LEAST_PARALLAX_SHARE) and is_rotation(H, points, centers):
        return "rotation"
    return "planar" if planar else ""


def _can_be_accident(off: BoolArray, inliers: BoolArray, sample_size: int, chance: float) -> bool:
    """Return whether the inliers among the matches `off` a line or plane could all be mismatches."""
    agreeing = int(np.count_nonzero(off & inliers))
    return false_alarms(int(np.count_nonzero(off)), agreeing, sample_size, chance) > MOST_FALSE_ALARMS


def off_line_mask(points: FloatArray, inliers: BoolArray, view: int, width: float) -> BoolArray:
    """Return which matches lie further than `width` from the line that holds the most inliers of a view.

    Args:
        points: (N, 4) matches in random order.
        inliers: (N,) mask, at least one of them True.
        view: 0 or 1.
        width: in the units of `points`.

    Returns:
        (N,) mask.
    """
    x, y = points[:, 2 * view], points[:, 2 * view + 1]
    a, b, c = _dominant_line(x[inliers], y[inliers], width)
    return np.asarray(np.abs(a * x + b * y + c) > width)


@kernel
def _dominant_line(x: FloatArray, y: FloatArray, width: float) -> tuple[float, float, float]:
    """Return the line a x + b y + c = 0, a^2 + b^2 = 1, through two sampled points, near most of the first points."""
    count, most, best, state = x.shape[0], -1, (1.0, 0.0, 0.0), np.empty(1, dtype=np.uint64)
    state[0] = count
    for _ in range(_LINES):
        i, j = int(uniform(state) * count), int(uniform(state) * count)
        a, b = y[i] - y[j], x[j] - x[i]
        norm = np.sqrt(a * a + b * b)
        a, b = (a / norm, b / norm) if norm > 0.0 else (1.0, 0.0)  # for two equal points any line will do
        c, on_line = -(a * x[i] + b * y[i]), 0
        for n in range(min(count, _MOST_SCORED)):
            on_line += abs(a * x[n] + b * y[n] + c) <= width
        if on_line > most:
            most, best = on_line, (a, b, c)
    return best


def is_rotation(H: FloatArray, points: FloatArray, centers: FloatArray) -> bool:
    """Return whether H = K R K^-1 for one focal length, with the center in the middle of the points of both views.

    Args:
        H: (3, 3) homography, view 2 from view 1, in the frame of the points.
        points: (N, 4) matches.
        centers: (4,) the origin of `points` in a frame that both views share, in the same units.
    """
    placed = points + centers
    low, high = np.quantile(np.vstack([placed[:, :2], placed[:, 2:]]), _EXTENT_QUANTILES, axis=0)
    middle, side = (low + high) / 2, float((high - low).max())
    to1, to2 = _translation(middle - centers[:2]), _translation(centers[2:] - middle)
    for focal in _FOCALS * side:
        K = np.diag([focal, focal, 1.0])
        stretch = np.linalg.svd(np.linalg.inv(K) @ to2 @ H @ to1 @ K, compute_uv=False)
        if stretch[0] <= (1 + _ROTATION_TOLERANCE) * stretch[2]:
            return True
    return False


def _translation(by: FloatArray) -> FloatArray:
    return np.array([[1, 0, by[0]], [0, 1, by[1]], [0, 0, 1]], dtype=np.float64)
