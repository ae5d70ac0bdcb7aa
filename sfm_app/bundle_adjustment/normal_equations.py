"""Normal equations of bundle adjustment, reduced to the cameras by eliminating points and poses."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.spatial.transform import Rotation

from sfm_app.bundle_adjustment.elimination import POSE, free_pose_columns, whiten_points
from sfm_app.bundle_adjustment.schur import Linearized, eliminate_points
from sfm_app.geometry.lenses.projections import CAMERA, PANORAMA, image_points, project_points, wrap_residuals
from sfm_app.geometry.spd_solve import project_to_psd, solve_positive, solve_sparse_positive

FloatArray = NDArray[np.float64]

DAMPING = 1e-6
"""Added to the diagonal, so that a photo with no observation left does not make the system singular. Chosen by hand;
not measured on its own."""
USUAL_NOISE_PX, USUAL_COUNT = 0.25, 4.0
"""Prior noise of a keypoint coordinate (the usual noise of SIFT), and its weight as a number of measurements. It
matters where there are hardly more observations than unknowns; beside thousands of observations it does not count.
docs/algorithms.md, Bundle adjustment."""
LOST_PX, MAX_DERIVATIVE = 1e4, 1e60
"""Residual and derivative above which an observation is lost, i.e. not used; the residual is also what a lost
observation costs. docs/algorithms.md, Bundle adjustment. Chosen by hand; not measured on their own."""


@dataclass(frozen=True, slots=True, eq=False)
class Bundle:
    """Cameras, posed photos, points, and observations of the points."""

    params: FloatArray
    """(C, 12) parameters as in `projections`: fx, fy, cx, cy in pixels, k1, k2, p1, p2, ..."""
    camera: NDArray[np.int64]
    """(I,) row of the camera of each photo."""
    R: FloatArray
    """(I, 3, 3) rotations, camera from world."""
    t: FloatArray
    """(I, 3) translations, camera from world."""
    X: FloatArray
    """(P, 3) points."""
    photo: NDArray[np.int64]
    """(N,) row of the photo of each observation."""
    point: NDArray[np.int64]
    """(N,) row of the point of each observation."""
    x: FloatArray
    """(N, 2) observed positions, in pixels."""
    family: NDArray[np.int64]
    """(C,) PERSPECTIVE, FISHEYE or PANORAMA of `projections`."""
    fixed: NDArray[np.bool_] | None = None
    """(C,) cameras that keep their parameters; None where all may change."""


@dataclass(frozen=True, slots=True, eq=False)
class ReducedSystem:
    """Cost as a function of a change d of the cameras, minimized over poses and points: cost - g'd + d'Hd / 2."""

    H: FloatArray
    """(12C, 12C) Hessian, in the order of `Bundle.params`."""
    g: FloatArray
    """(12C,) negative gradient."""
    noise_px: float
    """Standard deviation of a coordinate, from the residuals after the best linear step."""
    pose_step: FloatArray
    """(6I,) best change of the poses with fixed cameras."""
    pose_response: FloatArray
    """(6I, 12C) decrease of that change per change of the cameras."""
    point_step: FloatArray
    """(3P,) best change of the points with fixed poses and cameras."""
    seen: Linearized
    """All observations."""
    whiten: FloatArray
    """(P, 3, 3) from `whiten_points`."""
    lost: int
    """Number of observations that are not used: behind their camera, or not finite."""
    scores: FloatArray
    """(I, 12C) contributions of each photo's observations to g, with poses and points eliminated; they add up to g."""
    open_points: int
    """Number of points that their rays do not determine: at infinity, or seen from one position only. They do not move
    along undetermined directions."""

    def back_substitute(self, cameras: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the best changes of poses (I, 6) and points (P, 3) for a given change of the cameras (C, 12)."""
        poses = self.pose_step - np.einsum("ij,j->i", self.pose_response, cameras.ravel())
        follow = _unwhiten(self.whiten, self.seen.sum_by_point(self.seen.move(poses, cameras.ravel())))
        return poses.reshape(-1, POSE), self.point_step.reshape(-1, 3) - follow


def project(bundle: Bundle) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return predictions (N, 2), and their derivatives by camera (N, 2, 12), pose (N, 2, 6) and point (N, 2, 3).

    A pose changes by a rotation vector in the camera's axes, applied to R from the left, and by a shift of t.
    """
    rows, R = bundle.camera[bundle.photo], bundle.R[bundle.photo]
    turned = np.einsum("nij,nj->ni", R, bundle.X[bundle.point])
    found = project_points(turned + bundle.t[bundle.photo], bundle.params[rows], bundle.family[rows])
    if bundle.fixed is not None:
        found.by_camera[bundle.fixed[rows]] = 0.0
    by_pose = np.concatenate([np.cross(turned[:, None], found.by_point), found.by_point], 2)
    return found.x, found.by_camera, by_pose, np.einsum("nij,njk->nik", found.by_point, R)


def predict(bundle: Bundle) -> FloatArray:
    """Return the predictions of `project` (N, 2), without derivatives."""
    rows = bundle.camera[bundle.photo]
    turned = np.einsum("nij,nj->ni", bundle.R[bundle.photo], bundle.X[bundle.point])
    return image_points(turned + bundle.t[bundle.photo], bundle.params[rows], bundle.family[rows])


def residuals(bundle: Bundle, predicted: FloatArray) -> FloatArray:
    """Return (N, 2) observed less predicted positions, in pixels; in panoramas the short way round.

    Args:
        bundle: the model.
        predicted: (N, 2) from `project` or `predict`.
    """
    rows = bundle.camera[bundle.photo]
    return wrap_residuals(bundle.x - predicted, bundle.params[rows], bundle.family[rows])


def reduce(bundle: Bundle, scale_px: float) -> ReducedSystem:
    """Eliminate points, then poses (Schur complement), in the Gauss-Newton approximation.

    The covariance of the cameras is noise^2 H^-1.

    Args:
        bundle: the model; the result is accurate where poses and points minimize the cost.
        scale_px: s of the loss s^2 (sqrt(1 + |r|^2 / s^2) - 1), which is COLMAP's SOFT_L1.
    """
    r, by_view, by_point, used = _linearize(bundle, scale_px)
    whiten, rank = whiten_points(by_point, bundle.point, len(bundle.X))
    by_point = np.einsum("nki,nji->nkj", by_point, whiten[bundle.point])
    counts = len(bundle.R), len(bundle.params), len(bundle.X)
    seen = Linearized(bundle.photo, bundle.camera[bundle.photo], bundle.point, by_view, by_point, counts)
    poses, cameras = POSE * len(bundle.R), CAMERA * len(bundle.params)
    S, by_camera = eliminate_points(seen, DAMPING)
    rest = seen.drop_points(r)
    gradient = seen.sum_by_view(rest)
    free = free_pose_columns(bundle.R, bundle.t)
    right = np.column_stack([by_camera[:, free].T, gradient[free]])
    give = solve_sparse_positive(sparse.csr_array(S[free][:, free]), right)
    across = np.einsum("ij,jk->ik", by_camera[:, free], give)
    H, g = by_camera[:, poses:] - across[:, :-1], gradient[poses:] - across[:, -1]
    H = project_to_psd(0.5 * (H + H.T), seen.camera_squares())
    step = solve_positive(H, g[:, None])[:, 0]
    explained = np.sum(gradient[free] * give[:, -1]) + np.sum(g * step)
    left = max(float(np.sum(rest**2) - explained), 0.0) + USUAL_COUNT * USUAL_NOISE_PX**2
    spare = max(2 * int(np.count_nonzero(used)) - int(np.sum(rank)) - len(free) - cameras, 0) + USUAL_COUNT
    pose_step, pose_give = np.zeros(poses), np.zeros((poses, cameras))
    pose_step[free], pose_give[free] = give[:, -1], give[:, :-1]
    left_over = rest - seen.drop_points(seen.move(pose_step, np.zeros(cameras)))
    return ReducedSystem(
        H=H,
        g=g,
        noise_px=float(np.sqrt(left / spare)),
        pose_step=pose_step,
        pose_response=pose_give,
        point_step=_unwhiten(whiten, seen.sum_by_point(r)).ravel(),
        seen=seen,
        whiten=whiten,
        lost=len(used) - int(np.count_nonzero(used)),
        scores=seen.score(pose_give, left_over),
        open_points=int(np.count_nonzero(rank < 3)),
    )


def _unwhiten(whiten: FloatArray, points: FloatArray) -> FloatArray:
    """Return (P, 3) shifts of points from those of the whitened ones."""
    return np.asarray(np.einsum("pji,pj->pi", whiten, points), np.float64)


def apply_step(bundle: Bundle, params: FloatArray, poses: FloatArray, points: FloatArray) -> Bundle:
    """Return the bundle with new cameras, and with changed poses and points.

    Args:
        bundle: bundle to change; not changed in place.
        params: (C, 12) the new cameras, see `Bundle.params`.
        poses: (I, 6) changes: a rotation vector in the camera's axes, and a shift of t.
        points: (P, 3) shifts of the points.
    """
    R = Rotation.from_rotvec(poses[:, :3]).as_matrix() @ bundle.R
    return replace(bundle, params=params, R=R, t=bundle.t + poses[:, 3:], X=bundle.X + points)


def best_step(bundle: Bundle, reduced: ReducedSystem, params: FloatArray, scale_px: float) -> Bundle:
    """Return the bundle with new cameras, and with poses and points moved if that does not raise the cost.

    A point that would move behind a camera stays: along an undetermined direction a linear step has no bound.

    Args:
        bundle: bundle to change; not changed in place.
        reduced: the cost about it.
        params: (C, 12) the new cameras.
        scale_px: as in `reduce`.
    """
    nowhere = np.zeros((len(bundle.R), POSE)), np.zeros_like(bundle.X)
    poses, points = reduced.back_substitute(params - bundle.params)
    tried = [apply_step(bundle, params, *nowhere)]
    if np.isfinite(poses).all():
        points[~np.isfinite(points).all(axis=1)] = 0.0
        points[lost_points(apply_step(bundle, params, poses, points)) & ~lost_points(bundle)] = 0.0
        tried.insert(0, apply_step(bundle, params, poses, points))
    return min(tried, key=lambda one: cost(one, scale_px))


def cost(bundle: Bundle, scale_px: float) -> float:
    """Return half the sum of the loss of `reduce`; lost observations count with a residual of LOST_PX.

    Args:
        bundle: the model.
        scale_px: s of the loss, in pixels, > 0.
    """
    with np.errstate(all="ignore"):
        r = residuals(bundle, predict(bundle))
    return loss(r, usable_mask(bundle, r), scale_px)


def loss(r: FloatArray, usable: NDArray[np.bool_], scale_px: float) -> float:
    """Return half the sum of the loss of `reduce`, in squared pixels; what is not usable counts with LOST_PX.

    Args:
        r: (N, 2) residuals in pixels.
        usable: (N,) from `usable_mask`.
        scale_px: s of the loss, in pixels, > 0.
    """
    with np.errstate(all="ignore"):
        squares = np.where(usable, np.einsum("ni,ni->n", r, r), LOST_PX**2)
    return float(scale_px**2 * np.sum(np.sqrt(1.0 + squares / scale_px**2) - 1.0))


def usable_mask(bundle: Bundle, r: FloatArray, depth: FloatArray | None = None) -> NDArray[np.bool_]:
    """Return (N,) which observations are of points in front of their camera, with residuals below LOST_PX.

    A panorama also sees what is behind it.

    Args:
        bundle: the model.
        r: (N, 2) residuals in pixels.
        depth: (N,) of the points before their cameras; from the poses if None.
    """
    with np.errstate(all="ignore"):
        if depth is None:
            depth = np.einsum("nj,nj->n", bundle.R[bundle.photo, 2], bundle.X[bundle.point]) + bundle.t[bundle.photo, 2]
        ahead = (depth > 0.0) | (bundle.family[bundle.camera[bundle.photo]] == PANORAMA)
        return np.asarray(ahead & (np.abs(r) < LOST_PX).all(axis=1), np.bool_)


def lost_points(bundle: Bundle) -> NDArray[np.bool_]:
    """Return (P,) which points have a lost observation."""
    with np.errstate(all="ignore"):
        r = residuals(bundle, predict(bundle))
    return np.bincount(bundle.point[~usable_mask(bundle, r)], minlength=len(bundle.X)) > 0


def _linearize(bundle: Bundle, scale_px: float) -> tuple[FloatArray, FloatArray, FloatArray, NDArray[np.bool_]]:
    """Return weighted residuals (N, 2), derivatives by view (N, 2, 18) and point (N, 2, 3), and which are used (N,).

    The others are 0: points behind their camera, or in its principal plane, would distort all that is near.
    """
    with np.errstate(all="ignore"):
        predicted, by_camera, by_pose, by_point = project(bundle)
        r, by_view = residuals(bundle, predicted), np.concatenate([by_pose, by_camera], 2)
    return weigh(r, by_view, by_point, usable_mask(bundle, r), scale_px)


def weigh(
    r: FloatArray, by_view: FloatArray, by_point: FloatArray, usable: NDArray[np.bool_], scale_px: float
) -> tuple[FloatArray, FloatArray, FloatArray, NDArray[np.bool_]]:
    """Return residuals and their derivatives times the roots of their weights, and (N,) which of them are used.

    The others are 0.

    Args:
        r: (N, 2) residuals in pixels.
        by_view, by_point: (N, 2, k) and (N, 2, 3) derivatives of the projections.
        usable: (N,) from `usable_mask`.
        scale_px: as in `loss`.
    """
    with np.errstate(all="ignore"):
        largest = np.maximum(np.abs(by_view).max(axis=(1, 2), initial=0.0), np.abs(by_point).max(axis=(1, 2)))
        seen = usable & (largest < MAX_DERIVATIVE)
    r, by_view, by_point = (np.where(seen.reshape(-1, *[1] * (a.ndim - 1)), a, 0.0) for a in (r, by_view, by_point))
    root = (1.0 + np.einsum("ni,ni->n", r, r) / scale_px**2) ** -0.25
    return r * root[:, None], by_view * root[:, None, None], by_point * root[:, None, None], seen
