"""The relative pose of one pair of photos from F and two cameras, and the kind of the pair."""

from collections.abc import Iterator, Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from sfm_app.camera.bearings import bearings, pixels_per_radian
from sfm_app.fundamental.degeneracy import OFF_PLANE, dominant_homography, transfer_distance
from sfm_app.geometry.epipolar import (
    FIRST,
    SECOND,
    cross_matrix,
    decompose_essential,
    depths,
    eight_point,
    fit_rays,
    gradients,
    nearest_essential,
    rotation_residuals,
)
from sfm_app.geometry.least_squares import DECREASE, INCREASE, DampingRange
from sfm_app.geometry.poses import POSE_DOF, retract, write_essential
from sfm_app.jit import kernel
from sfm_app.types import Calibration, EpipolarFit, RelativePose
from sfm_app.types.arrays import FloatArray
from sfm_app.types.camera import PERSPECTIVE

# Initial relative poses of a fit, where F does not determine how far the camera has turned.
#
# With a long lens, matches determine the directions of the epipolar lines, but hardly where they meet: the rotation
# of E = K2' F K1 is then due to noise, and a fit that starts there ends in a wrong local minimum. But the lines of
# both views determine everything except that turn, if camera 2 looks at what camera 1 looked at. So several turns
# are tried.

LEAST_PLANAR = 8
"""Least number of matches: a homography has eight parameters, a match determines two, and half should be redundant.
Counted."""
TURNS_DEG = (-55.0, -30.0, -12.0, 12.0, 30.0, 55.0)
"""Turns about the scene. On the 30 pairs of a long-lens orbit (dinoSparseRing, K given) these lead to the best pose
that 24 turns from -60 to 60 lead to; the choice rests on that set alone, and only adds starts elsewhere.
docs/algorithms.md, From K to relative poses."""


def planar_starts(used: FloatArray) -> Iterator[tuple[FloatArray, FloatArray]]:
    """Yield up to four R and t that explain the matches if their points lie on one plane.

    Args:
        used: (N, 4) inliers as points of the plane z = 1, view 1 and view 2.
    """
    if len(used) < LEAST_PLANAR:
        return
    try:
        H, _ = cv2.findHomography(used[:, :2], used[:, 2:], 0)
    except cv2.error:
        return
    if H is None or not np.isfinite(H).all() or abs(np.linalg.det(H)) < 1e-12:
        return
    _, rotations, steps, _ = cv2.decomposeHomographyMat(H, np.eye(3))
    for R, t in zip(rotations, steps, strict=True):
        length = float(np.linalg.norm(t))
        if np.isfinite(R).all() and length > 1e-9:
            yield np.asarray(R, np.float64), np.asarray(t, np.float64).ravel() / length


def turned_starts(used: FloatArray, E: FloatArray) -> Iterator[tuple[FloatArray, FloatArray]]:
    """Yield R and t of a camera that has turned about the middle of the scene, for every turn of `TURNS_DEG`.

    Args:
        used: (N, 4) inliers as points of the plane z = 1, view 1 and view 2.
        E: (3, 3) of any scale; only the directions of its epipolar lines through the middle are used.
    """
    if not len(used):  # panoramas that look away from each other
        return
    middles = np.median(used, axis=0)
    first, second = np.append(middles[:2], 1.0), np.append(middles[2:], 1.0)
    # near the middles g1 dx1 + g2 dx2 = 0: what moves along g1 in view 1 moves against g2 in view 2
    g1, g2 = (E.T @ second)[:2], (E @ first)[:2]
    lengths = np.hypot(*g1), np.hypot(*g2)
    if min(lengths) <= 1e-12 * max(*lengths, 1e-300):
        return
    roll = np.arctan2(-g2[1], -g2[0]) - np.arctan2(g1[1], g1[0])
    K = cross_matrix(np.append(g1 / lengths[0], 0.0))
    angles = np.radians(TURNS_DEG)[:, None, None]
    upright = np.array([[np.cos(roll), -np.sin(roll), 0.0], [np.sin(roll), np.cos(roll), 0.0], [0.0, 0.0, 1.0]])
    turns = upright @ (np.eye(3) + np.sin(angles) * K + (1.0 - np.cos(angles)) * (K @ K))  # Rodrigues
    steps = lengths[1] / lengths[0] * second - turns @ first  # the middle of the scene stays in the middle
    for R, t, length in zip(turns, steps, np.linalg.norm(steps, axis=1), strict=True):
        if length > 1e-9:
            yield R, t / length


# The five degrees of freedom of a relative pose, fitted to matches with known cameras.
#
# F has seven parameters, a relative pose five: with K known, the other two no longer fit noise, mismatches that
# happen to lie right, and repeated structure. On real photos that alone halves the error of the direction of
# translation.

SIGMAS_PX = (0.5, 0.2)
"""Scales of the Cauchy loss, used one after the other. Keypoints are good to about 0.2 px; with a wider scale the
mismatches that a second structure explains pull the pose to a compromise between both. docs/algorithms.md, From K to
relative poses."""
STEPS = 12
"""Largest number of steps at each scale. Chosen by hand; halved and doubled by `benchmarks.sensitivity`."""
DAMPING = DampingRange(first=1e-4, least=1e-9, most=1e6)
"""Damping of the Levenberg-Marquardt steps. Chosen by hand; halved and doubled by `benchmarks.sensitivity`."""
GAIN = 1e-6
"""Relative decrease of the cost below which they end. Chosen by hand; halved and doubled by
`benchmarks.sensitivity`."""
_DIFFERENCE_STEP = 1e-6
"""Step of the parameters for finite differences. Chosen by hand; halved and doubled by `benchmarks.sensitivity`."""


def refine_pose(lines: FloatArray, R: FloatArray, t: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Refine the pose (R, t) by robust least squares of Sampson distances (Levenberg-Marquardt).

    Args:
        lines: (N, 18) matches as bearing vectors with derivatives (`geometry.lenses.bearings`), view 1 and view 2.
        R: (3, 3) rotation of view 2 from view 1.
        t: (3,) direction of its translation.
    """
    pose = np.concatenate([R.ravel(), t / np.linalg.norm(t)])
    for sigma in SIGMAS_PX:
        pose = _descend(lines, pose, sigma)
    return pose[:9].reshape(3, 3).copy(), pose[9:].copy()


def pose_distances(lines: FloatArray, R: FloatArray, t: FloatArray) -> FloatArray:
    """Return the Sampson distances (N,) of matches to a relative pose, in pixels, >= 0.

    Args:
        lines: (N, 18) matches as bearing vectors with derivatives (`geometry.lenses.bearings`), view 1 and view 2.
        R: (3, 3) rotation of view 2 from view 1.
        t: (3,) unit vector along its translation.
    """
    pose = np.concatenate([R.ravel(), t])
    return np.abs(_distances(lines, pose))


@kernel
def _distance(line: FloatArray, E: FloatArray) -> float:
    """Return the signed distance of one match, (18,)."""
    l0 = E[0, 0] * line[0] + E[0, 1] * line[1] + E[0, 2] * line[2]
    l1 = E[1, 0] * line[0] + E[1, 1] * line[1] + E[1, 2] * line[2]
    l2 = E[2, 0] * line[0] + E[2, 1] * line[1] + E[2, 2] * line[2]
    k0 = E[0, 0] * line[9] + E[1, 0] * line[10] + E[2, 0] * line[11]
    k1 = E[0, 1] * line[9] + E[1, 1] * line[10] + E[2, 1] * line[11]
    k2 = E[0, 2] * line[9] + E[1, 2] * line[10] + E[2, 2] * line[11]
    g0 = k0 * line[3] + k1 * line[4] + k2 * line[5]
    g1 = k0 * line[6] + k1 * line[7] + k2 * line[8]
    h0 = l0 * line[12] + l1 * line[13] + l2 * line[14]
    h1 = l0 * line[15] + l1 * line[16] + l2 * line[17]
    algebraic = line[9] * l0 + line[10] * l1 + line[11] * l2
    return float(algebraic / np.sqrt(g0 * g0 + g1 * g1 + h0 * h0 + h1 * h1 + 1e-300))


@kernel
def _distances(lines: FloatArray, pose: FloatArray) -> FloatArray:
    E, found = np.empty((3, 3)), np.empty(lines.shape[0])
    write_essential(pose, E)
    for i in range(lines.shape[0]):
        found[i] = _distance(lines[i], E)
    return found


@kernel
def _cost(lines: FloatArray, pose: FloatArray, sigma: float) -> float:
    E, cost = np.empty((3, 3)), 0.0
    write_essential(pose, E)
    for i in range(lines.shape[0]):
        cost += np.log1p((_distance(lines[i], E) / sigma) ** 2)
    return cost


@kernel
def _system(lines: FloatArray, pose: FloatArray, sigma: float) -> tuple[FloatArray, FloatArray]:
    """Return the approximate Hessian (5, 5) and the negative gradient (5,) of half the cost."""
    Es, J, step = np.empty((1 + POSE_DOF, 3, 3)), np.empty(POSE_DOF), np.zeros(POSE_DOF)
    A, b = np.zeros((POSE_DOF, POSE_DOF)), np.zeros(POSE_DOF)
    write_essential(pose, Es[0])
    for j in range(POSE_DOF):
        step[j] = _DIFFERENCE_STEP
        write_essential(retract(pose, step), Es[1 + j])
        step[j] = 0.0
    for i in range(lines.shape[0]):
        r = _distance(lines[i], Es[0]) / sigma
        weight = 1.0 / (1.0 + r * r)
        for j in range(POSE_DOF):
            J[j] = (_distance(lines[i], Es[1 + j]) / sigma - r) / _DIFFERENCE_STEP
        for j in range(POSE_DOF):
            b[j] -= weight * r * J[j]
            for k in range(POSE_DOF):
                A[j, k] += weight * J[j] * J[k]
    return A, b


@kernel
def _descend(lines: FloatArray, pose: FloatArray, sigma: float) -> FloatArray:
    cost, damping = _cost(lines, pose, sigma), DAMPING.first
    for _ in range(STEPS):
        A, b = _system(lines, pose, sigma)
        before, found = cost, False
        while damping < DAMPING.most and not found:
            step = _solve(A, b, damping)
            trial = retract(pose, step)
            lower = _cost(lines, trial, sigma)
            if lower < cost:
                pose, cost, found = trial, lower, True
                damping = max(DECREASE * damping, DAMPING.least)
            else:
                damping *= INCREASE
        if not found or before - cost < GAIN * before:
            break
    return pose


@kernel
def _solve(A: FloatArray, b: FloatArray, damping: float) -> FloatArray:
    """Solve the damped system by Cholesky's decomposition."""
    L, x = np.zeros((POSE_DOF, POSE_DOF)), np.empty(POSE_DOF)
    for i in range(POSE_DOF):
        for j in range(i + 1):
            value = A[i, j]
            if i == j:
                value += damping * A[i, i] + 1e-9
            for k in range(j):
                value -= L[i, k] * L[j, k]
            L[i, j] = np.sqrt(max(value, 1e-300)) if i == j else value / L[j, j]
    for i in range(POSE_DOF):
        x[i] = b[i]
        for k in range(i):
            x[i] -= L[i, k] * x[k]
        x[i] /= L[i, i]
    for i in range(POSE_DOF - 1, -1, -1):
        for k in range(i + 1, POSE_DOF):
            x[i] -= L[k, i] * x[k]
        x[i] /= L[i, i]
    return x


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
