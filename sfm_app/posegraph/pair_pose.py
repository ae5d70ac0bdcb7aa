"""The relative pose of one pair of photos from F and two cameras, and the kind of the pair."""

from collections.abc import Iterator, Sequence

import cv2
import numpy as np

from sfm_app.camera.bearings import bearings
from sfm_app.fundamental.degeneracy import DEGENERACY, dominant_homography, transfer_distance
from sfm_app.fundamental.refits import solve_cholesky
from sfm_app.geometry import epipolar
from sfm_app.geometry.least_squares import DECREASE, INCREASE, DampingRange
from sfm_app.geometry.poses import (
    POSE_DOF,
    is_in_front,
    pose_distances,
    ray_angles_deg,
    retract,
    sampson_of_rays,
    write_essential,
    write_nearby_essentials,
)
from sfm_app.jit import kernel
from sfm_app.types import Calibration, EpipolarFit, EpipolarGeometry, RelativePose
from sfm_app.types.arrays import BoolArray, FloatArray
from sfm_app.types.camera import PERSPECTIVE

# Initial poses. With a long lens, matches determine the directions of epipolar lines, but hardly where they meet: the
# rotation of E = K2' F K1 is noise, and a fit from there ends in a wrong local minimum. The lines determine all but
# the turn of a camera that looks at the same scene, so several turns are tried.


class OPTIONS:
    """Thresholds for the pose of a pair; docs/algorithms/relative-poses.md."""

    turns_deg: tuple[float, ...] = (-55.0, -30.0, -12.0, 12.0, 30.0, 55.0)
    """Turns about the scene that initial poses try. Chosen on a long-lens orbit; more turns give the same pose
    there."""
    min_matches: int = 8
    """Least matches for a pose or a homography: twice the number that the eight parameters of the latter need."""
    min_in_front: float = 0.9
    """Least share of inliers in front of both cameras for a pose from another start than F. Chosen by hand."""
    min_improvement: float = 0.01
    """Relative decrease of the cost that such a pose needs. Chosen by hand."""
    screened: int = 60
    """Inliers that choose among the four poses of an essential matrix, and that starts are fitted to first. Chosen by
    hand."""
    promising: float = 1.2
    """Largest ratio of their cost there to the best one, for a fit to all inliers. Chosen by hand."""
    same_pose: float = 0.01
    """Largest difference of the elements of R and t of equal poses. Chosen by hand."""
    rotation_deg: float = 5.0
    """Median angle of rays above which no rotation is tested. Chosen by hand."""
    min_cosine_ahead: float = 0.5
    """Least cosine to the optical axis of unit rays in tests for planes: z = 1 stretches the noise. Chosen by hand."""
    reweighted_fits: int = 2
    """Fits of E to rays with weights from the fit before. Chosen by hand."""
    sigmas_px: tuple[float, float] = (0.5, 0.2)
    """Scales of the Cauchy loss of a refinement, one after the other: keypoints are accurate to about 0.2 px.
    Measured."""
    steps: int = 12
    """Largest number of steps at each scale. Chosen by hand."""
    gain: float = 1e-6
    """Relative decrease of the cost below which they end. Chosen by hand."""


def planar_starts(used: FloatArray) -> Iterator[tuple[FloatArray, FloatArray]]:
    """Yield up to four R and t that explain inliers (N, 4), points of the plane z = 1 in both views, by one plane."""
    if len(used) < OPTIONS.min_matches:
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
    """Yield R and t of a camera that turned about the scene, by the directions of the lines of E in its middle."""
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
    K = epipolar.cross_matrix(np.append(g1 / lengths[0], 0.0))
    angles = np.radians(OPTIONS.turns_deg)[:, None, None]
    upright = np.array([[np.cos(roll), -np.sin(roll), 0.0], [np.sin(roll), np.cos(roll), 0.0], [0.0, 0.0, 1.0]])
    turns = upright @ (np.eye(3) + np.sin(angles) * K + (1.0 - np.cos(angles)) * (K @ K))  # Rodrigues
    steps = lengths[1] / lengths[0] * second - turns @ first  # the middle of the scene stays in the middle
    for R, t, length in zip(turns, steps, np.linalg.norm(steps, axis=1), strict=True):
        if length > 1e-9:
            yield R, t / length


# Refinement. F has seven parameters, a relative pose five: with K known, the other two no longer fit noise.

DAMPING = DampingRange(first=1e-4, least=1e-9, most=1e6)
"""Damping of the Levenberg-Marquardt steps. Chosen by hand."""
_DIFFERENCE_STEP = 1e-6
"""Step of the parameters for finite differences. Chosen by hand."""


def refine_pose(lines: FloatArray, R: FloatArray, t: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Refine R (3, 3) and t (3,) for bearing vectors (N, 18) by robust least squares of Sampson distances."""
    pose = np.concatenate([R.ravel(), t / np.linalg.norm(t)])
    for sigma in OPTIONS.sigmas_px:
        pose = _descend(lines, pose, sigma, OPTIONS.steps, OPTIONS.gain)
    return pose[:9].reshape(3, 3).copy(), pose[9:].copy()


@kernel
def _cost(lines: FloatArray, pose: FloatArray, sigma: float) -> float:
    E, cost = np.empty((3, 3)), 0.0
    write_essential(pose, E)
    for i in range(lines.shape[0]):
        cost += np.log1p((sampson_of_rays(lines[i, :9], lines[i, 9:], E) / sigma) ** 2)
    return cost


@kernel
def _system(lines: FloatArray, pose: FloatArray, sigma: float) -> tuple[FloatArray, FloatArray]:
    """Return the approximate Hessian (5, 5) and the negative gradient (5,) of half the cost."""
    Es, J = np.empty((1 + POSE_DOF, 3, 3)), np.empty(POSE_DOF)
    A, b = np.zeros((POSE_DOF, POSE_DOF)), np.zeros(POSE_DOF)
    write_nearby_essentials(pose, _DIFFERENCE_STEP, Es)
    for i in range(lines.shape[0]):
        r = sampson_of_rays(lines[i, :9], lines[i, 9:], Es[0]) / sigma
        weight = 1.0 / (1.0 + r * r)
        for j in range(POSE_DOF):
            J[j] = (sampson_of_rays(lines[i, :9], lines[i, 9:], Es[1 + j]) / sigma - r) / _DIFFERENCE_STEP
        for j in range(POSE_DOF):
            b[j] -= weight * r * J[j]
            for k in range(POSE_DOF):
                A[j, k] += weight * J[j] * J[k]
    return A, b


@kernel
def _descend(lines: FloatArray, pose: FloatArray, sigma: float, steps: int, gain: float) -> FloatArray:
    cost, damping, step = _cost(lines, pose, sigma), DAMPING.first, np.empty(POSE_DOF)
    for _ in range(steps):
        A, b = _system(lines, pose, sigma)
        before, improved = cost, False
        while damping < DAMPING.most and not improved:
            lifted = A.copy()
            for j in range(POSE_DOF):
                lifted[j, j] += damping * A[j, j] + 1e-9
            trial = retract(pose, step) if solve_cholesky(lifted, b, step) else pose
            lower = _cost(lines, trial, sigma)
            if lower < cost:
                pose, cost, improved = trial, lower, True
                damping = max(DECREASE * damping, DAMPING.least)
            else:
                damping *= INCREASE
        if not improved or before - cost < gain * before:
            break
    return pose


Pose = tuple[FloatArray, FloatArray]
"""R (3, 3) and t (3,)."""


class Pair:
    """All matches of a pair, (M, 2) pixels each, as bearing vectors of its cameras; `max_error_px` of an inlier."""

    def __init__(
        self, points: tuple[FloatArray, FloatArray], cameras: Sequence[Calibration], max_error_px: float
    ) -> None:
        self.cameras = tuple(cameras)
        self.lines = np.hstack([bearings(x, camera) for x, camera in zip(points, cameras, strict=True)])
        self.max_error_px = max_error_px
        self.trusted = all(camera.is_estimated or camera.is_claimed for camera in cameras)

    def initial_pose(self, fit: EpipolarGeometry) -> Pose:
        """Return R and t from F and the cameras, before refinement."""
        inliers, E = self.lines[fit.inliers], self.essential_matrix(fit)
        chosen = _screen(inliers)
        poses = epipolar.decompose_essential(epipolar.nearest_essential(E))
        return max(poses, key=lambda pose: int(np.count_nonzero(is_in_front(chosen, *pose))))

    def essential_matrix(self, fit: EpipolarGeometry) -> FloatArray:
        """Return E from F and the cameras, with singular values that noise makes unequal."""
        (first, second), inliers = self.cameras, self.lines[fit.inliers]
        is_wide = any(camera.projection != PERSPECTIVE for camera in self.cameras)
        if is_wide or not isinstance(fit, EpipolarFit):  # by eight points with errors in pixels
            E = epipolar.fit_rays(inliers[:, epipolar.FIRST], inliers[:, epipolar.SECOND])
            for _ in range(OPTIONS.reweighted_fits):
                E = epipolar.fit_rays(
                    inliers[:, epipolar.FIRST], inliers[:, epipolar.SECOND], epipolar.gradients(E, inliers) ** -2.0
                )
            return E
        if first.is_bent or second.is_bent:  # F does not model distortion
            return epipolar.eight_point(inliers[:, :2], inliers[:, 9:11])
        return second.K.T @ fit.F @ first.K

    def pose(self, R: FloatArray, t: FloatArray, inliers: BoolArray, *, guided: bool = False) -> RelativePose:
        """Return a pose with the statistics of its inliers, a mask (M,)."""
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

    def inliers(self, R: FloatArray, t: FloatArray) -> BoolArray:
        """Return a mask (M,) of the matches within the threshold of a pose with |t| = 1."""
        return pose_distances(self.lines, R, t) <= self.max_error_px

    def kind(self, used: FloatArray, R: FloatArray, t: FloatArray, angle_deg: float) -> str:
        """Return `RelativePose.kind` by the inliers `used` (N, 18) and their median triangulation angle."""
        within, clear = DEGENERACY.off * self.max_error_px, DEGENERACY.clear_share
        if angle_deg < OPTIONS.rotation_deg and np.mean(epipolar.rotation_residuals(used, R) <= within) >= clear:
            return "rotation"
        ahead, unit = points_ahead(used), epipolar.pixels_per_radian(self.lines.reshape(-1, 9))
        if len(ahead) < (1.0 - clear) * len(used):
            return "calibrated"
        H = dominant_homography(np.asfortranarray(ahead), epipolar.cross_matrix(t) @ R, self.max_error_px / unit)
        on_plane = np.count_nonzero(transfer_distance(H, ahead) <= within / unit)
        return "planar" if on_plane >= clear * len(used) else "calibrated"


def estimate_pose(pair: Pair, fit: EpipolarGeometry) -> RelativePose | None:
    """Estimate the relative pose of F; None if too few matches agree. With a guessed camera, the inliers of F stay."""
    R, t = pair.initial_pose(fit)
    if not pair.trusted:
        return pair.pose(R, t, fit.inliers)
    R, t = _refine_best_start(pair, fit, (R, t))
    inliers = pair.inliers(R, t)
    return pair.pose(R, t, inliers) if np.count_nonzero(inliers) >= OPTIONS.min_matches else None


def _refine_best_start(pair: Pair, fit: EpipolarGeometry, start: Pose) -> Pose:
    """Return the refined pose that the inliers of F fit best, of those with the points in front of both cameras.

    Another start than F must be clearly better and lose no inliers: of the two poses that a plane allows, the wrong one
    loses the matches off the plane.
    """
    used = pair.lines[fit.inliers]
    best = refine_pose(used, *start)
    if not len(used):
        return best
    lowest, most = _pose_cost(used, *best), int(np.count_nonzero(pair.inliers(*best)))
    if is_in_front(used, *best).mean() < OPTIONS.min_in_front:
        lowest, most = np.inf, 0
    ahead = points_ahead(used)
    planar = planar_starts(ahead) if fit.degeneracy == "planar" else ()
    few = _screen(used)
    promising, tried = np.inf, [best]
    for other in (best, *turned_starts(ahead, pair.essential_matrix(fit)), *planar):
        R, t = refine_pose(few, *other)
        promising = min(promising, OPTIONS.promising * _pose_cost(few, R, t))
        if lowest < np.inf and (_pose_cost(few, R, t) > promising or _is_known((R, t), tried)):
            continue
        tried.append((R, t))
        R, t = refine_pose(used, R, t)
        cost, count = _pose_cost(used, R, t), int(np.count_nonzero(pair.inliers(R, t)))
        if cost < (1.0 - OPTIONS.min_improvement) * lowest and count >= most:
            t = t if np.mean(is_in_front(used, R, t)) >= 0.5 else -t
            if is_in_front(used, R, t).mean() >= OPTIONS.min_in_front:
                best, lowest, most = (R, t), cost, count
    return best


def _screen(used: FloatArray) -> FloatArray:
    """Return `screened` matches at most, evenly chosen."""
    return used[np.linspace(0, len(used) - 1, min(len(used), OPTIONS.screened)).astype(np.int64)]


def _is_known(pose: Pose, tried: Sequence[Pose]) -> bool:
    """Return whether a pose was tried; t and -t have the same epipolar lines."""
    R, t = pose
    differences = (max(np.abs(R - A).max(), min(np.abs(t - b).max(), np.abs(t + b).max())) for A, b in tried)
    return bool(min(differences) < OPTIONS.same_pose)


def _pose_cost(used: FloatArray, R: FloatArray, t: FloatArray) -> float:
    return float(np.sum(np.log1p((pose_distances(used, R, t) / OPTIONS.sigmas_px[-1]) ** 2)))


def points_ahead(used: FloatArray) -> FloatArray:
    """Return (M, 4) points of the planes z = 1 of both views, of the matches (N, 18) far ahead in both."""
    ahead = (used[:, 2] > OPTIONS.min_cosine_ahead) & (used[:, 11] > OPTIONS.min_cosine_ahead)
    return np.hstack([used[ahead, 0:2] / used[ahead, 2:3], used[ahead, 9:11] / used[ahead, 11:12]])
