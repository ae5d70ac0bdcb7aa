"""Normal equations of bundle adjustment, reduced to the cameras by eliminating points and poses.

A point couples all views that see it. The derivatives by a whitened point are orthonormal, so that one product of
sparse matrices eliminates all points: time grows with the squares of the track lengths, and memory with the pairs of
photos that share a point.
"""

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from sfm_app.camera.projection import image_points, project_points, wrap_residuals
from sfm_app.camera.rows import CAMERA, PANORAMA
from sfm_app.geometry.least_squares import project_to_psd, solve_positive, solve_sparse_positive
from sfm_app.types.arrays import BoolArray, FloatArray, IndexArray

if TYPE_CHECKING:
    from scipy import sparse


POSE = 6
"""Number of parameters of a pose. By definition."""
BLOCK = 6
"""Unknowns of a block of sparse matrices: a pose, or half of a camera."""


class REDUCTION:
    """Limits of the reduction (docs/algorithms/bundle-adjustment.md)."""

    min_information: float = 1e-11
    """Share of a point's information below which a direction counts as undetermined: rounding leaves this much of the
    depth of rays that nearly coincide. Two rays 1.5 degrees apart leave 2e-4. Chosen by hand."""
    damping: float = 1e-6
    """Added to the diagonal, so that a photo without observations does not make the system singular. Chosen by hand."""
    usual_noise_px: float = 0.25
    """Prior noise of a keypoint coordinate: the usual noise of SIFT. Chosen by hand."""
    usual_count: float = 4.0
    """Weight of the prior noise as a number of measurements; it matters with few observations. Chosen by hand."""
    efficient_scale: float = 2.385
    """Scale of Cauchy's loss in standard deviations of the noise (Holland and Welsch 1977)."""
    lost_px: float = 1e4
    """Residual above which an observation is lost, i.e. not used; a lost observation costs as much. Chosen by hand."""
    max_derivative: float = 1e60
    """Derivative above which an observation is lost. Chosen by hand."""


def whiten_points(by_point: FloatArray, point: IndexArray, points: int) -> tuple[FloatArray, IndexArray]:
    """Return W (P, 3, 3) that makes derivatives by W^-T X orthonormal over the observations of a point, and its rank.

    Along undetermined directions, W is 0. The derivatives (N, 2, 3) are weighted; `point` has their rows (N,).
    """
    H = np.zeros((points, 3, 3))
    products = np.einsum("nki,nkj->nij", by_point, by_point)
    for i in range(3):
        for j in range(3):
            H[:, i, j] = np.bincount(point, products[:, i, j], points)
    diagonal = np.einsum("pii->pi", H)
    scale = np.sqrt(np.where(diagonal > 0.0, diagonal, 1.0))
    values, vectors = np.linalg.eigh(H / (scale[:, :, None] * scale[:, None, :]))
    determined = values > REDUCTION.min_information
    gains = np.where(determined, np.where(determined, values, 1.0) ** -0.5, 0.0)
    return gains[:, :, None] * vectors.transpose(0, 2, 1) / scale[:, None, :], np.count_nonzero(determined, axis=1)


def free_pose_columns(R: FloatArray, t: FloatArray) -> IndexArray:
    """Return the free pose columns when the gauge is fixed: the first photo, and one coordinate of the farthest one."""
    centers = -np.einsum("nji,nj->ni", R, t)
    far = int(np.argmax(np.linalg.norm(centers - centers[0], axis=1)))
    relative = R[far] @ (centers[0] - centers[far])
    held = {POSE * far + 3 + int(np.argmax(np.abs(relative)))} | set(range(POSE))
    return np.array([k for k in range(POSE * len(R)) if k not in held], np.int64)


def elimination_width(photo: IndexArray, point: IndexArray) -> float:
    """Return the root mean square width, in photos, of the envelope of the poses' normal equations.

    Photos that share a point are tied. In a street few are, wherever it leads; in a room all are. A factorization costs
    the square of this width for each photo, and the steps of conjugate gradients grow with the length of a street. The
    order is that of Cuthill and McKee: no elimination in it fills more, and orders by nested dissection fill less.
    """
    from scipy.sparse import coo_array, csr_array
    from scipy.sparse.csgraph import reverse_cuthill_mckee

    if not len(photo):
        return 0.0
    shape = int(point.max()) + 1, int(photo.max()) + 1
    visible = coo_array((np.ones(len(photo), np.int32), (point, photo)), shape=shape).tocsr()
    tied = csr_array(visible.T @ visible)
    order = reverse_cuthill_mckee(tied, symmetric_mode=True)
    place = np.argsort(order)
    row, column = (place[ends] for ends in tied.nonzero())
    first = np.arange(len(order))
    np.minimum.at(first, row, column)
    return float(np.sqrt(np.mean((np.arange(len(order)) - first + 1.0) ** 2)))


@dataclass(frozen=True, slots=True, eq=False)
class Bundle:
    """Cameras, posed photos, points, and observations of the points."""

    params: FloatArray
    """(C, 12) parameters as in `camera.projection`: fx, fy, cx, cy in pixels, k1, k2, p1, p2, ..."""
    camera: IndexArray
    """(I,) row of the camera of each photo."""
    R: FloatArray
    t: FloatArray
    """(I, 3, 3) rotations and (I, 3) translations, camera from world."""
    X: FloatArray
    """(P, 3) points."""
    photo: IndexArray
    point: IndexArray
    """(N,) rows of the photo and the point of each observation."""
    x: FloatArray
    """(N, 2) observed positions, in pixels."""
    family: IndexArray
    """(C,) PERSPECTIVE, FISHEYE or PANORAMA of `camera.projection`."""
    fixed: BoolArray | None = None
    """(C,) cameras that keep their parameters; None where all may change."""


@dataclass(frozen=True, slots=True, eq=False)
class Linearized:
    """Weighted residuals and derivatives of all observations, two rows for each; 0 for lost ones."""

    r: FloatArray
    """(2N,) residuals."""
    by_view: "sparse.bsr_array"
    """(2N, V) derivatives by the unknowns besides the points, in blocks of six."""
    by_point: "sparse.bsr_array"
    """(2N, 3P) derivatives by the whitened points: orthonormal columns."""
    products: "sparse.bsr_array"
    """(3P, V) products of the derivatives by points and by the other unknowns."""
    whiten: FloatArray
    """(P, 3, 3) from `whiten_points`."""
    rank: IndexArray
    """(P,) from `whiten_points`."""
    used: int
    """Number of observations that are not lost."""
    tails: float
    """From `tail_share`."""

    def eliminate_points(self) -> "sparse.csr_array":
        """Return the matrix (V, V) of the unknowns besides the points (Schur complement)."""
        from scipy.sparse import csr_array

        return csr_array(self.by_view.T @ self.by_view - self.products.T @ self.products)

    def drop_points(self, values: FloatArray) -> FloatArray:
        """Return values (2N,) less their part that the best shift of the points explains."""
        return np.asarray(values - self.by_point @ (self.by_point.T @ values), np.float64)

    def unwhiten(self, points: FloatArray) -> FloatArray:
        """Return shifts (P, 3) of points from shifts (3P,) of the whitened points."""
        return np.asarray(np.einsum("pji,pj->pi", self.whiten, points.reshape(-1, 3)), np.float64)


def linearize(
    bundle: Bundle, projected: tuple[FloatArray, FloatArray, FloatArray], blocks: IndexArray, unknowns: int,
    scale_px: float, depth: FloatArray | None = None,
) -> Linearized:  # fmt: skip
    """Weigh residuals and derivatives, and whiten the points.

    Args:
        projected: residuals (N, 2), derivatives (N, 2, 6k) by k blocks of six unknowns, and (N, 2, 3) by points.
        blocks: (N, k) numbers of these blocks, ascending.
        unknowns: number of all unknowns besides the points.
        depth: as of `usable_mask`.
    """
    from scipy.sparse import bsr_array

    # points behind their camera, or in its principal plane, would distort everything near them
    r, by_view, by_point, used = weigh(*projected, usable_mask(bundle, projected[0], depth), scale_px)
    del projected  # nearly half of the memory
    whiten, rank = whiten_points(by_point, bundle.point, len(bundle.X))
    by_point = np.einsum("nki,nji->nkj", by_point, whiten[bundle.point])
    (count, k), rows = blocks.shape, np.arange(len(r) + 1)
    by_view = by_view.reshape(count, 2, k, BLOCK).transpose(0, 2, 1, 3).reshape(-1, 2, BLOCK)
    J = bsr_array((by_view, blocks.ravel(), k * rows), shape=(2 * count, unknowns))
    B = bsr_array((by_point, bundle.point, rows), shape=(2 * count, 3 * len(bundle.X)))
    tails = tail_share(np.einsum("ni,ni->n", r[used], r[used]), scale_px)
    return Linearized(r.ravel(), J, B, B.T @ J, whiten, rank, int(np.count_nonzero(used)), tails)


def tail_share(weighted: FloatArray, scale_px: float) -> float:
    """Return the mean square residual with the weights of SOFT_L1 over that with Cauchy's (N,), in px^2.

    Deviations must cover what the loss ignores: things that move, and lenses that the model does not describe. The
    scale of SOFT_L1 is twice the usual noise.
    """
    if not np.any(weighted):
        return 1.0
    weight = 1.0 - weighted / scale_px**2
    milder = (1.0 + weighted / weight / (2.0 * REDUCTION.usual_noise_px) ** 2) ** -0.5
    return float(np.average(weighted / weight, weights=milder) / np.average(weighted / weight, weights=weight))


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
    observed: Linearized
    scores: FloatArray
    """(I, 12C) contributions of each photo to g, with poses and points eliminated; they add up to g."""
    open_points: int
    """Number of undetermined points: at infinity, or seen from one position only."""

    def back_substitute(self, cameras: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the best changes of poses (I, 6) and points (P, 3) for a given change of the cameras (C, 12)."""
        poses = self.pose_step - np.einsum("ij,j->i", self.pose_response, cameras.ravel())
        follow = self.observed.unwhiten(self.observed.products @ np.concatenate([poses, cameras.ravel()]))
        return poses.reshape(-1, POSE), self.point_step.reshape(-1, 3) - follow


def project(bundle: Bundle) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return predictions (N, 2), and their derivatives by camera (N, 2, 12), pose (N, 2, 6) and point (N, 2, 3).

    A pose changes by a rotation vector in the camera's axes, applied to R from the left, and by a shift of t.
    """
    rows, R = bundle.camera[bundle.photo], bundle.R[bundle.photo]
    rotated = np.einsum("nij,nj->ni", R, bundle.X[bundle.point])
    projected = project_points(rotated + bundle.t[bundle.photo], bundle.params[rows], bundle.family[rows])
    if bundle.fixed is not None:
        projected.by_camera[bundle.fixed[rows]] = 0.0
    by_pose = np.concatenate([np.cross(rotated[:, None], projected.by_point), projected.by_point], 2)
    return projected.x, projected.by_camera, by_pose, np.einsum("nij,njk->nik", projected.by_point, R)


def residuals(bundle: Bundle, predicted: FloatArray | None = None) -> FloatArray:
    """Return observed less predicted positions (N, 2), in pixels, by `project` or anew; in panoramas the short way."""
    rows = bundle.camera[bundle.photo]
    cameras = bundle.params[rows], bundle.family[rows]
    with np.errstate(all="ignore"):
        if predicted is None:
            rotated = np.einsum("nij,nj->ni", bundle.R[bundle.photo], bundle.X[bundle.point])
            predicted = image_points(rotated + bundle.t[bundle.photo], *cameras)
        return wrap_residuals(bundle.x - predicted, *cameras)


def reduce(bundle: Bundle, scale_px: float) -> ReducedSystem:
    """Eliminate points, then poses (Schur complement), in the Gauss-Newton approximation.

    The covariance of the cameras is noise^2 H^-1. It is accurate where poses and points minimize the cost. The loss is
    Cauchy's, s^2 / 2 log(1 + |r|^2 / s^2), with s = `scale_px`.
    """
    from scipy.sparse import bsr_array, eye_array

    photos, poses, cameras = len(bundle.R), POSE * len(bundle.R), CAMERA * len(bundle.params)
    first = photos + CAMERA // BLOCK * bundle.camera[bundle.photo]
    blocks = np.column_stack([bundle.photo, first, first + 1])
    observed = linearize(bundle, _residuals_and_derivatives(bundle), blocks, poses + cameras, scale_px)
    J, B, BJ = observed.by_view, observed.by_point, observed.products
    S = observed.eliminate_points() + REDUCTION.damping * eye_array(poses + cameras, format="csr")
    by_camera = S[poses:].toarray()
    rest = observed.drop_points(observed.r)
    gradient = J.T @ rest
    free = free_pose_columns(bundle.R, bundle.t)
    response = solve_sparse_positive(S[free][:, free], np.column_stack([by_camera[:, free].T, gradient[free]]))
    across = np.einsum("ij,jk->ik", by_camera[:, free], response)
    H, g = by_camera[:, poses:] - across[:, :-1], gradient[poses:] - across[:, -1]
    before = np.asarray(J.power(2).sum(axis=0), np.float64)
    H = project_to_psd(0.5 * (H + H.T), before[poses:])
    step = solve_positive(H, g[:, None])[:, 0]
    explained = np.sum(gradient[free] * response[:, -1]) + np.sum(g * step)
    noise = (
        observed.tails * max(float(np.sum(rest**2) - explained), 0.0)
        + REDUCTION.usual_count * REDUCTION.usual_noise_px**2
    )
    redundancy = max(2 * observed.used - int(np.sum(observed.rank)) - len(free) - cameras, 0) + REDUCTION.usual_count
    pose_step, pose_response = np.zeros(poses), np.zeros((poses, cameras))
    pose_step[free], pose_response[free] = response[:, -1], response[:, :-1]
    residue = rest - observed.drop_points(J @ np.append(pose_step, np.zeros(cameras)))
    rows = np.arange(len(bundle.x) + 1)
    by_photo = bsr_array((residue.reshape(-1, 2, 1), bundle.photo, rows), shape=(len(residue), photos))
    products = by_photo.T @ J - (by_photo.T @ B) @ BJ
    return ReducedSystem(
        H=H,
        g=g,
        noise_px=float(np.sqrt(noise / redundancy)),
        pose_step=pose_step,
        pose_response=pose_response,
        point_step=observed.unwhiten(B.T @ observed.r).ravel(),
        observed=observed,
        scores=products @ np.vstack([-pose_response, np.eye(cameras)]),
        open_points=int(np.count_nonzero(observed.rank < 3)),
    )


def _residuals_and_derivatives(bundle: Bundle) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return residuals (N, 2), and derivatives by pose and camera (N, 2, 18) and by point (N, 2, 3)."""
    with np.errstate(all="ignore"):
        predicted, by_camera, by_pose, by_point = project(bundle)
        return residuals(bundle, predicted), np.concatenate([by_pose, by_camera], 2), by_point


def apply_step(bundle: Bundle, params: FloatArray, poses: FloatArray, points: FloatArray) -> Bundle:
    """Return the bundle with new cameras (C, 12), changed poses (I, 6), and points shifted by (P, 3).

    The change of a pose is a rotation vector in the camera's axes, and a shift of t.
    """
    from scipy.spatial.transform import Rotation

    R = Rotation.from_rotvec(poses[:, :3]).as_matrix() @ bundle.R
    return replace(bundle, params=params, R=R, t=bundle.t + poses[:, 3:], X=bundle.X + points)


def best_step(bundle: Bundle, reduced: ReducedSystem, params: FloatArray, scale_px: float) -> Bundle:
    """Return the bundle with new cameras (C, 12), and with poses and points moved if that does not raise the cost.

    A point that would move behind a camera stays: along an undetermined direction a linear step has no bound.
    """
    no_change = np.zeros((len(bundle.R), POSE)), np.zeros_like(bundle.X)
    poses, points = reduced.back_substitute(params - bundle.params)
    candidates = [apply_step(bundle, params, *no_change)]
    if np.isfinite(poses).all():
        points[~np.isfinite(points).all(axis=1)] = 0.0
        points[lost_points(apply_step(bundle, params, poses, points)) & ~lost_points(bundle)] = 0.0
        candidates.insert(0, apply_step(bundle, params, poses, points))
    return min(candidates, key=lambda one: cost(one, scale_px))


def bundle_scale(bundle: Bundle) -> float:
    """Return the `loss_scale` of a bundle."""
    r = residuals(bundle)
    return loss_scale(r, usable_mask(bundle, r))


def cost(bundle: Bundle, scale_px: float) -> float:
    """Return half the sum of the loss of `reduce`; lost observations count with a residual of `lost_px`."""
    r = residuals(bundle)
    return loss(r, usable_mask(bundle, r), scale_px)


def loss(r: FloatArray, usable: BoolArray, scale_px: float) -> float:
    """Return half the sum of the loss of `reduce` over residuals (N, 2) in px^2; lost ones count `lost_px`."""
    with np.errstate(all="ignore"):
        squares = np.where(usable, np.einsum("ni,ni->n", r, r), REDUCTION.lost_px**2)
    return float(0.5 * scale_px**2 * np.sum(np.log1p(squares / scale_px**2)))


def loss_scale(r: FloatArray, usable: BoolArray) -> float:
    """Return the scale of the loss in pixels from the median of residuals (N, 2): outliers do not change it.

    With normal noise, Cauchy's loss is then 95 % efficient (Holland and Welsch 1977).
    """
    lengths = np.linalg.norm(r[usable], axis=1)
    noise = float(np.median(lengths)) / math.sqrt(2.0 * math.log(2.0)) if len(lengths) else 0.0
    usual = REDUCTION.usual_count * REDUCTION.usual_noise_px**2
    return REDUCTION.efficient_scale * math.sqrt(
        (len(lengths) * noise**2 + usual) / (len(lengths) + REDUCTION.usual_count)
    )


def usable_mask(bundle: Bundle, r: FloatArray, depth: FloatArray | None = None) -> BoolArray:
    """Return the mask (N,) of observations of points in front of their camera, with residuals below `lost_px`.

    A panorama also sees points behind it. Without depths (N,) before the cameras, they come from the poses.
    """
    with np.errstate(all="ignore"):
        if depth is None:
            depth = np.einsum("nj,nj->n", bundle.R[bundle.photo, 2], bundle.X[bundle.point]) + bundle.t[bundle.photo, 2]
        ahead = (depth > 0.0) | (bundle.family[bundle.camera[bundle.photo]] == PANORAMA)
        return np.asarray(ahead & (np.abs(r) < REDUCTION.lost_px).all(axis=1), np.bool_)


def lost_points(bundle: Bundle) -> BoolArray:
    """Return the mask (P,) of points with a lost observation."""
    return np.bincount(bundle.point[~usable_mask(bundle, residuals(bundle))], minlength=len(bundle.X)) > 0


def weigh(
    r: FloatArray, by_view: FloatArray, by_point: FloatArray, usable: BoolArray, scale_px: float
) -> tuple[FloatArray, FloatArray, FloatArray, BoolArray]:
    """Return weighted residuals (N, 2), derivatives (N, 2, k) and (N, 2, 3), and the mask (N,) of used ones, else 0."""
    with np.errstate(all="ignore"):
        largest = np.maximum(np.abs(by_view).max(axis=(1, 2), initial=0.0), np.abs(by_point).max(axis=(1, 2)))
        used = usable & (largest < REDUCTION.max_derivative)
    r, by_view, by_point = (np.where(used.reshape(-1, *[1] * (a.ndim - 1)), a, 0.0) for a in (r, by_view, by_point))
    root = (1.0 + np.einsum("ni,ni->n", r, r) / scale_px**2) ** -0.5
    return r * root[:, None], by_view * root[:, None, None], by_point * root[:, None, None], used
