"""Matches that do not determine F: all on one plane, or taken without moving the camera.

Where one homography H explains the matches, every F = [e]x H does, for any epipole e: the estimator then picks the e
that catches the most accidental inliers. What tells a real epipole is matches off the plane, more of them than accident
gives.
"""

import numpy as np
from numpy.typing import NDArray

from sfm_app.geometry.epipolar import cross_matrix, epipoles
from sfm_app.ransac.chance import MOST_FALSE_ALARMS, accidental_share, false_alarms

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

_SAMPLES = 64
_SAMPLE_SIZE, _PARALLAX_SAMPLE = 3, 2
_LEAST_AREA = 1e-6
_MOST_SCORED = 300
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
        wrong: (M,) distances of mismatches to F, from `chance.mismatch_distances`.
        threshold: largest distance of an inlier.
        centres: (4,) the origin of `points` in a frame that both views share, in the same units.

    Returns:
        "rotation" where the camera only turned, "planar" where all matches lie on one plane (or too close to one to
        tell), "" where F is determined.
    """
    H = dominant_homography(points[inliers], F, threshold)
    off_plane = transfer_distance(H, points) > _PARALLAX * threshold
    agreeing, chance = int(np.count_nonzero(off_plane & inliers)), accidental_share(wrong, threshold)
    if false_alarms(int(np.count_nonzero(off_plane)), agreeing, _PARALLAX_SAMPLE, chance) <= MOST_FALSE_ALARMS:
        return ""
    return "rotation" if is_rotation(H, points, centres) else "planar"


def dominant_homography(points: FloatArray, F: FloatArray, threshold: float) -> FloatArray:
    """The homography of the plane that holds the most matches, among those compatible with F.

    They are H = A - e2 v' with A = [e2]x F and v' x1 = b for every match on the plane, where
    b = (x2 x A x1)'(x2 x e2) / |x2 x e2|^2 (Hartley and Zisserman, Result 13.6): a linear regression, three parameters.

    Args:
        points: (N, 4) inliers of F in random order, N >= 3.
        F: (3, 3).
        threshold: largest distance of a match to the plane.

    Returns:
        (3, 3), x2 ~ H x1.
    """
    e2 = epipoles(F)[1]
    A = cross_matrix(e2) @ F
    x1, x2 = _homogeneous(points[:, :2]), _homogeneous(points[:, 2:])
    towards = np.cross(x2, e2)
    b = (np.cross(x2, x1 @ A.T) * towards).sum(axis=1) / np.maximum((towards**2).sum(axis=1), np.finfo(float).tiny)
    planes = _sampled_planes(x1, b)
    # H x1 = A x1 - e2 (v' x1): for all sampled planes at once
    mapped, depth = (x1 @ A.T)[:_MOST_SCORED], planes @ x1[:_MOST_SCORED].T
    h = [mapped[:, k] - e2[k] * depth for k in range(3)]
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        missed = np.hypot(*(h[k] / h[2] - x2[:_MOST_SCORED, k] for k in range(2)))
    best = planes[int(np.argmax(np.count_nonzero(missed <= np.sqrt(2) * threshold, axis=1)))]
    on_plane = transfer_distance(A - np.outer(e2, best), points) <= threshold
    if np.count_nonzero(on_plane) >= _SAMPLE_SIZE:
        best = np.linalg.lstsq(x1[on_plane], b[on_plane], rcond=None)[0]
    return A - np.outer(e2, best)


def _sampled_planes(x1: FloatArray, b: FloatArray) -> FloatArray:
    """(S, 3) solutions v of v' x1 = b through random triples, and the v that fits all matches best."""
    triples = np.random.default_rng(len(x1)).integers(len(x1), size=(_SAMPLES, _SAMPLE_SIZE))
    usable = triples[np.abs(np.linalg.det(x1[triples])) > _LEAST_AREA]
    solved = np.linalg.solve(x1[usable], b[usable][..., None])[..., 0]
    return np.vstack([solved, np.linalg.lstsq(x1, b, rcond=None)[0]])


def transfer_distance(H: FloatArray, points: FloatArray) -> FloatArray:
    """(N,) |x2 - H x1| / sqrt(2): about the distance of the match (x1, x2) in 4D to those that fit H exactly."""
    mapped = _homogeneous(points[:, :2]) @ H.T
    depth = np.where(np.abs(mapped[:, 2]) > np.finfo(float).tiny, mapped[:, 2], np.finfo(float).tiny)
    with np.errstate(over="ignore"):
        return np.asarray(np.hypot(*(mapped[:, :2] / depth[:, None] - points[:, 2:]).T) / np.sqrt(2))


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


def _homogeneous(x: FloatArray) -> FloatArray:
    return np.column_stack([x, np.ones(len(x))])
