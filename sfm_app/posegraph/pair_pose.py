"""The relative pose of one pair of photos from F and two cameras, and the kind of the pair."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from sfm_app.geometry.epipolar import cross_matrix, eight_point
from sfm_app.geometry.essential import decompose_essential, nearest_essential
from sfm_app.geometry.lenses.bearings import bearings, pixels_per_radian
from sfm_app.geometry.lenses.ray_epipolar import FIRST, SECOND, depths, fit_rays, gradients, rotation_residuals
from sfm_app.posegraph.refine import SIGMAS_PX, pose_distances, refine_pose
from sfm_app.posegraph.starts import planar_starts, turned_starts
from sfm_app.ransac.degeneracy.dominant_plane import OFF_PLANE, dominant_homography, transfer_distance
from sfm_app.types import Calibration, EpipolarFit, RelativePose
from sfm_app.types.calibration import PERSPECTIVE

FloatArray = NDArray[np.float64]
Pose = tuple[FloatArray, FloatArray]
"""R (3, 3) and t (3,)."""

CLEAR_SHARE = 0.95
"""A pair is planar, or a rotation, if this share of its inliers fits that. docs/algorithms.md, From K to relative
poses. Chosen by hand; halved and doubled by `benchmarks.sensitivity`."""
SAMPLE_SIZE = 200
"""Number of points that decide between the four poses of an essential matrix. Chosen by hand; halved and doubled by
`benchmarks.sensitivity`."""
MIN_INLIERS = 8
"""Least number of inliers that determine the pose of a pair. Chosen by hand; halved and doubled by
`benchmarks.sensitivity`."""
MIN_IN_FRONT, MIN_IMPROVEMENT = 0.9, 0.01
"""A pose from a start other than that of F needs this share of its inliers in front of both cameras, and a cost lower
by this share. Chosen by hand; halved and doubled by `benchmarks.sensitivity`."""
SCREENED, PROMISING, SAME_POSE = 60, 1.2, 0.01
"""Inliers to which other starts are fitted first, and the largest ratio of their cost there to that of the best pose
for a start to be fitted to all: a pose that is better on all inliers is not a fifth worse on sixty of them. Third, the
largest difference of R and t of starts that led to one pose. Chosen by hand; not measured on their own."""
ROTATION_DEG = 5.0
"""Median angle of rays above which no rotation is tried. Chosen by hand; not measured on its own."""
LEAST_AHEAD = 0.5
"""Least cosine of the angle to the optical axis of rays of length 1 in tests for planes: the plane z = 1 stretches the
noise of wider ones. Rays of a perspective camera end on that plane and are all used. Chosen by hand; not measured on
its own."""
REWEIGHTED_FITS = 2
"""Fits of E to rays with weights from the fit before. Chosen by hand; not measured on its own."""


class Pair:
    """The matches of a pair as bearing vectors of its cameras.

    Args:
        points: x1, x2, each (M, 2) pixels: all matches of the pair.
        cameras: of photo 1 and photo 2.
        max_error_px: largest Sampson distance of an inlier.
    """

    def __init__(
        self, points: tuple[FloatArray, FloatArray], cameras: Sequence[Calibration], max_error_px: float
    ) -> None:
        self.cameras = tuple(cameras)
        self.lines = np.hstack([bearings(x, camera) for x, camera in zip(points, cameras, strict=True)])
        self.max_error_px = max_error_px
        self.trusted = all(camera.is_estimated or camera.method == "exif" for camera in cameras)

    def initial_pose(self, fit: EpipolarFit) -> Pose:
        """Return R and t from F and the cameras, before refinement."""
        inliers, E = self.lines[fit.inliers], self.essential_matrix(fit)
        chosen = inliers[np.linspace(0, len(inliers) - 1, min(len(inliers), SAMPLE_SIZE)).astype(np.int64)]
        poses = decompose_essential(nearest_essential(E))
        return max(poses, key=lambda pose: int(np.count_nonzero(is_in_front(chosen, *pose))))

    def essential_matrix(self, fit: EpipolarFit) -> FloatArray:
        """Return E from F and the cameras, with singular values that are unequal because of noise."""
        first, second = self.cameras
        if any(camera.projection != PERSPECTIVE for camera in self.cameras):
            return _essential_of_rays(self.lines[fit.inliers])
        if first.is_bent or second.is_bent:  # F does not model distortion
            inliers = self.lines[fit.inliers]
            return eight_point(inliers[:, :2], inliers[:, 9:11])
        return second.K.T @ fit.F @ first.K

    def pose(self, R: FloatArray, t: FloatArray, inliers: NDArray[np.bool_], *, guided: bool = False) -> RelativePose:
        """Return a pose with the statistics of its inliers.

        Args:
            R: (3, 3) rotation of view 2 from view 1.
            t: (3,) unit vector along its translation.
            inliers: (M,) which matches agree with the pose.
            guided: whether the rotation came from other pairs.
        """
        used = self.lines[inliers]
        front = is_in_front(used, R, t)
        angle_deg = float(np.median(ray_angles_deg(used[front], R))) if front.any() else 0.0
        return RelativePose(
            R, t, inliers,
            angle_deg=angle_deg,
            in_front=float(front.mean()) if len(used) else 0.0,
            kind=self.kind(used, R, t, angle_deg) if self.trusted else "uncalibrated",
            guided=guided,
        )  # fmt: skip

    def inliers(self, R: FloatArray, t: FloatArray) -> NDArray[np.bool_]:
        """Return (M,) which matches lie within the threshold of a pose.

        Args:
            R: (3, 3) rotation of view 2 from view 1.
            t: (3,) unit vector along its translation.
        """
        return pose_distances(self.lines, R, t) <= self.max_error_px

    def kind(self, used: FloatArray, R: FloatArray, t: FloatArray, angle_deg: float) -> str:
        """Return the kind of a pose by its inliers, see `RelativePose.kind`.

        Args:
            used: (N, 18) inliers as bearing vectors, view 1 and view 2.
            R: (3, 3) rotation of view 2 from view 1.
            t: (3,) unit vector along its translation.
            angle_deg: median angle between the two rays of a match.
        """
        within = OFF_PLANE * self.max_error_px
        if angle_deg < ROTATION_DEG and np.mean(rotation_residuals(used, R) <= within) >= CLEAR_SHARE:
            return "rotation"
        ahead, unit = points_ahead(used), pixels_per_radian(self.lines.reshape(-1, 9))
        if len(ahead) < (1.0 - CLEAR_SHARE) * len(used):
            return "calibrated"
        H = dominant_homography(np.asfortranarray(ahead), cross_matrix(t) @ R, self.max_error_px / unit)
        on_plane = np.count_nonzero(transfer_distance(H, ahead) <= within / unit)
        return "planar" if on_plane >= CLEAR_SHARE * len(used) else "calibrated"


def estimate_pose(pair: Pair, fit: EpipolarFit) -> RelativePose | None:
    """Estimate the relative pose of a fundamental matrix; None if too few matches agree with it.

    If a camera is a guess, E is wrong by as much as the guess, and the inliers of F are kept.

    Args:
        pair: matches and cameras.
        fit: the fundamental matrix and its inliers.
    """
    R, t = pair.initial_pose(fit)
    if not pair.trusted:
        return pair.pose(R, t, fit.inliers)
    R, t = _refine_best_start(pair, fit, (R, t))
    inliers = pair.inliers(R, t)
    return pair.pose(R, t, inliers) if np.count_nonzero(inliers) >= MIN_INLIERS else None


def _refine_best_start(pair: Pair, fit: EpipolarFit, start: Pose) -> Pose:
    """Return the refined pose that the inliers of F fit best, of those with the points in front of both cameras.

    The pose from F itself is kept unless another one is clearly better and loses no inliers: of the two poses that a
    plane allows, the wrong one loses the matches off the plane.
    """
    used = pair.lines[fit.inliers]
    best = refine_pose(used, *start)
    if not len(used):
        return best
    lowest, most = _pose_cost(used, *best), int(np.count_nonzero(pair.inliers(*best)))
    if is_in_front(used, *best).mean() < MIN_IN_FRONT:
        lowest, most = np.inf, 0
    ahead = points_ahead(used)
    planar = planar_starts(ahead) if fit.degeneracy == "planar" else ()
    few = used[np.linspace(0, len(used) - 1, min(len(used), SCREENED)).astype(np.int64)]
    promising, tried = np.inf, [best]
    for other in (best, *turned_starts(ahead, pair.essential_matrix(fit)), *planar):
        R, t = refine_pose(few, *other)
        promising = min(promising, PROMISING * _pose_cost(few, R, t))
        if lowest < np.inf and (_pose_cost(few, R, t) > promising or _is_known((R, t), tried)):
            continue
        tried.append((R, t))
        R, t = refine_pose(used, R, t)
        cost, count = _pose_cost(used, R, t), int(np.count_nonzero(pair.inliers(R, t)))
        if cost < (1.0 - MIN_IMPROVEMENT) * lowest and count >= most:
            t = t if np.mean(is_in_front(used, R, t)) >= 0.5 else -t
            if is_in_front(used, R, t).mean() >= MIN_IN_FRONT:
                best, lowest, most = (R, t), cost, count
    return best


def _is_known(found: Pose, tried: Sequence[Pose]) -> bool:
    """Return whether a start led to a pose that was tried; t and -t have the same epipolar lines."""
    R, t = found
    off = (max(np.abs(R - A).max(), min(np.abs(t - b).max(), np.abs(t + b).max())) for A, b in tried)
    return bool(min(off) < SAME_POSE)


def _pose_cost(used: FloatArray, R: FloatArray, t: FloatArray) -> float:
    """Return the cost that `refine_pose` minimizes at its last scale."""
    return float(np.sum(np.log1p((pose_distances(used, R, t) / SIGMAS_PX[-1]) ** 2)))


def is_in_front(used: FloatArray, R: FloatArray, t: FloatArray) -> NDArray[np.bool_]:
    """Return (N,) whether each point is in front of both cameras.

    Args:
        used: (N, 18) matches as bearing vectors, view 1 and view 2.
        R: (3, 3) rotation of view 2 from view 1.
        t: (3,) translation.
    """
    first, second = depths(used, R, t)
    return (first > 0) & (second > 0)


def ray_angles_deg(used: FloatArray, R: FloatArray) -> FloatArray:
    """Return (N,) degrees between the two rays of each match: the triangulation angles if t fits.

    Args:
        used: (N, 18) matches as bearing vectors, view 1 and view 2.
        R: (3, 3) rotation of view 2 from view 1.
    """
    h1, h2 = used[:, FIRST] @ R.T, used[:, SECOND]
    sine = np.linalg.norm(np.cross(h1, h2), axis=1)
    return np.asarray(np.degrees(np.arctan2(sine, (h1 * h2).sum(axis=1))), np.float64)


def points_ahead(used: FloatArray) -> FloatArray:
    """Return (M, 4) points of the planes z = 1 of view 1 and view 2, of the matches that both views see far ahead.

    Args:
        used: (N, 18) matches as bearing vectors, view 1 and view 2.
    """
    ahead = (used[:, 2] > LEAST_AHEAD) & (used[:, 11] > LEAST_AHEAD)
    return np.hstack([used[ahead, 0:2] / used[ahead, 2:3], used[ahead, 9:11] / used[ahead, 11:12]])


def _essential_of_rays(used: FloatArray) -> FloatArray:
    """Return E (3, 3) of inliers (N, 18), by eight points with errors in pixels."""
    E = fit_rays(used[:, FIRST], used[:, SECOND])
    for _ in range(REWEIGHTED_FITS):
        E = fit_rays(used[:, FIRST], used[:, SECOND], gradients(E, used) ** -2.0)
    return E
