"""Normal equations of bundle adjustment, reduced to the cameras by eliminating points and poses.

A point couples all views that see it. Points are eliminated one by one, without a matrix of all observations: each adds
to the blocks of its views, so that time grows with the squares of the track lengths, and memory with the pairs of
photos that share a point.
"""

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from sfm_app.camera.projection import CAMERA, PANORAMA, image_points, project_points, wrap_residuals
from sfm_app.geometry.least_squares import project_to_psd, solve_positive, solve_sparse_positive
from sfm_app.jit import kernel
from sfm_app.types.arrays import FloatArray, IndexArray

if TYPE_CHECKING:
    from scipy import sparse


POSE = 6
"""Number of parameters of a pose. By definition."""


@dataclass(frozen=True, slots=True)
class ReductionOptions:
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
    lost_px: float = 1e4
    """Residual above which an observation is lost, i.e. not used; a lost observation costs as much. Chosen by hand."""
    max_derivative: float = 1e60
    """Derivative above which an observation is lost. Chosen by hand."""


REDUCTION = ReductionOptions()


def whiten_points(by_point: FloatArray, point: NDArray[np.int64], points: int) -> tuple[FloatArray, NDArray[np.int64]]:
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
    unit = H / (scale[:, :, None] * scale[:, None, :])
    # the pivots of the Cholesky decomposition
    second = unit[:, 1, 1] - unit[:, 1, 0] ** 2
    across = unit[:, 2, 1] - unit[:, 2, 0] * unit[:, 1, 0]
    third = unit[:, 2, 2] - unit[:, 2, 0] ** 2 - across**2 / np.maximum(second, REDUCTION.min_information)
    fixed = (unit[:, 0, 0] > 0.0) & (second > REDUCTION.min_information) & (third > REDUCTION.min_information)
    W, rank = np.zeros((points, 3, 3)), np.full(points, 3)
    W[fixed] = np.linalg.inv(np.linalg.cholesky(H[fixed]))
    values, vectors = np.linalg.eigh(unit[~fixed])
    determined = values > REDUCTION.min_information
    gains = np.where(determined, np.where(determined, values, 1.0) ** -0.5, 0.0)
    W[~fixed] = gains[:, :, None] * vectors.transpose(0, 2, 1) / scale[~fixed, None, :]
    rank[~fixed] = np.count_nonzero(determined, axis=1)
    return W, rank


def free_pose_columns(R: FloatArray, t: FloatArray) -> NDArray[np.int64]:
    """Return the free pose columns when the gauge is fixed: the first photo, and one coordinate of the farthest one."""
    centers = -np.einsum("nji,nj->ni", R, t)
    far = int(np.argmax(np.linalg.norm(centers - centers[0], axis=1)))
    relative = R[far] @ (centers[0] - centers[far])
    held = {POSE * far + 3 + int(np.argmax(np.abs(relative)))} | set(range(POSE))
    return np.array([k for k in range(POSE * len(R)) if k not in held], np.int64)


def elimination_width(photo: NDArray[np.int64], point: NDArray[np.int64]) -> float:
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
    place = np.empty(len(order), np.int64)
    place[order] = np.arange(len(order))
    row, column = (place[ends] for ends in tied.nonzero())
    first = np.arange(len(order))
    np.minimum.at(first, row, column)
    return float(np.sqrt(np.mean((np.arange(len(order)) - first + 1.0) ** 2)))


@dataclass(frozen=True, slots=True, eq=False)
class Linearized:
    """Weighted derivatives of all observations; the derivatives by a point are orthonormal over its observations."""

    photo: IndexArray
    camera: IndexArray
    point: IndexArray
    """(N,) rows of the photo, the camera and the point of each observation."""
    by_view: FloatArray
    """(N, 2, 18) derivatives by pose and camera."""
    by_point: FloatArray
    """(N, 2, 3) derivatives by the whitened point."""
    counts: tuple[int, int, int]
    """Photos I, cameras C and points P."""

    def sum_by_point(self, values: FloatArray) -> FloatArray:
        """Return products (P, 3) of the derivatives by points with values (N, 2)."""
        along = np.einsum("nki,nk->ni", self.by_point, values)
        return np.stack([np.bincount(self.point, along[:, i], self.counts[2]) for i in range(3)], axis=1)

    def drop_points(self, values: FloatArray) -> FloatArray:
        """Return values (N, 2) less their part that the best shift of the points explains."""
        shifts = self.sum_by_point(values)[self.point]
        return np.asarray(values - np.einsum("nki,ni->nk", self.by_point, shifts), np.float64)

    def sum_by_view(self, values: FloatArray) -> FloatArray:
        """Return products (6I + 12C,) of the derivatives by poses and cameras with values (N, 2)."""
        along = np.einsum("nki,nk->ni", self.by_view, values)
        poses = [np.bincount(self.photo, along[:, i], self.counts[0]) for i in range(POSE)]
        cameras = [np.bincount(self.camera, along[:, POSE + i], self.counts[1]) for i in range(CAMERA)]
        return np.concatenate([np.stack(poses, axis=1).ravel(), np.stack(cameras, axis=1).ravel()])

    def camera_squares(self) -> FloatArray:
        """Return sums (12C,) of the squared derivatives by each parameter of the cameras."""
        squares = np.einsum("nki,nki->ni", self.by_view[:, :, POSE:], self.by_view[:, :, POSE:])
        sums = [np.bincount(self.camera, squares[:, i], self.counts[1]) for i in range(CAMERA)]
        return np.stack(sums, axis=1, dtype=np.float64).ravel()

    def move(self, poses: FloatArray, cameras: FloatArray) -> FloatArray:
        """Return changes (N, 2) of the projections by changes of the poses (6I,) and cameras (12C,)."""
        change = np.hstack([poses.reshape(-1, POSE)[self.photo], cameras.reshape(-1, CAMERA)[self.camera]])
        return np.asarray(np.einsum("nki,ni->nk", self.by_view, change), np.float64)

    def score(self, response: FloatArray, residue: FloatArray) -> FloatArray:
        """Return the scores (I, 12C) of the cameras' parameters, with poses and points eliminated.

        The response is as `ReducedSystem.pose_response`; the residuals (N, 2) are those after poses and points.
        """
        scores = np.zeros((response.shape[1], self.counts[0]))
        observed = self.photo, self.camera, self.point, self.by_view, self.by_point
        add_scores(observed, np.ascontiguousarray(response.T), residue, self.counts[2], scores)
        return scores.T


def eliminate_points(observed: Linearized, damping: float) -> "tuple[sparse.csr_array, FloatArray]":
    """Return the matrix (6I, 6I) of the poses, and the rows (12C, 6I + 12C) of the cameras, after the points."""
    from scipy import sparse

    photos, cameras, points = observed.counts
    A = np.einsum("nki,nkj->nij", observed.by_point, observed.by_view)
    order = np.lexsort((observed.photo, observed.point))
    pattern = _pairs_of_photos(observed)
    blocks = np.zeros((pattern.nnz, POSE, POSE))
    couple_poses(
        (observed.photo[order], observed.point[order], observed.by_view[order, :, :POSE], A[order, :, :POSE]),
        (
            np.argsort(observed.photo[order], kind="stable"),
            _starts(observed.photo, photos),
            _starts(observed.point, points),
        ),
        (pattern.indptr, pattern.indices),
        damping,
        blocks,
    )
    S = sparse.bsr_array((blocks, pattern.indices, pattern.indptr), shape=(POSE * photos, POSE * photos)).tocsr()
    names, group = np.unique(observed.point * cameras + observed.camera, return_inverse=True)
    sums = np.zeros((len(names), 3, CAMERA))
    rows = np.zeros((CAMERA * cameras, POSE * photos + CAMERA * cameras))
    couple_cameras(
        (observed.photo, observed.camera, observed.point, observed.by_view, A),
        (group, names % max(cameras, 1), _starts(names // max(cameras, 1), points), sums),
        POSE * photos,
        damping,
        rows,
    )
    return S, rows


def _pairs_of_photos(observed: Linearized) -> "sparse.csr_array":
    """Return a matrix (I, I) with an entry for each photo and each pair that shares a point, columns ascending."""
    from scipy import sparse

    photos, _, points = observed.counts
    ones = np.ones(len(observed.photo), np.int32)
    visible = sparse.csr_array((ones, (observed.photo, observed.point)), shape=(photos, points))
    pattern = sparse.csr_array(visible @ visible.T + sparse.eye_array(photos, dtype=np.int32))
    pattern.sort_indices()
    return pattern


def _starts(rows: IndexArray, count: int) -> IndexArray:
    """Return starts (count + 1,) of the observations of each row, in the order of rows."""
    return np.concatenate([[0], np.cumsum(np.bincount(rows, minlength=count))]).astype(np.int64)


@kernel
def couple_poses(observed: Any, order: Any, pattern: Any, damping: float, blocks: FloatArray) -> None:
    """Add up the blocks of all pairs of photos, in place.

    Args:
        observed: observations in the order of points, then photos: (N,) photo, (N,) point, (N, 2, 6) derivatives by
        pose, and their products (N, 3, 6) with the derivatives by point.
        order: these observations by photo; starts of the photos in this order, and of the points in that above.
        pattern: first block of each photo, and the other photo of each block, ascending.
        blocks: (B, 6, 6), zeros at first.
    """
    photo, point, by_pose, A = observed
    by_photo, photo_starts, point_starts = order
    starts, others = pattern
    photos = len(photo_starts) - 1
    place = np.zeros(photos, np.int64)
    for i in range(photos):
        for e in range(starts[i], starts[i + 1]):
            place[others[e]] = e
        own = place[i]
        for u in range(POSE):
            blocks[own, u, u] += damping
        for a in range(photo_starts[i], photo_starts[i + 1]):
            k = by_photo[a]
            for u in range(POSE):
                for v in range(POSE):
                    blocks[own, u, v] += by_pose[k, 0, u] * by_pose[k, 0, v] + by_pose[k, 1, u] * by_pose[k, 1, v]
            first = k
            while first > point_starts[point[k]] and photo[first - 1] == i:
                first -= 1
            for m in range(first, point_starts[point[k] + 1]):
                e = place[photo[m]]
                for u in range(POSE):
                    x, y, z = A[k, 0, u], A[k, 1, u], A[k, 2, u]
                    for v in range(POSE):
                        blocks[e, u, v] -= x * A[m, 0, v] + y * A[m, 1, v] + z * A[m, 2, v]
    mirror_blocks(starts, others, blocks)


@kernel
def mirror_blocks(starts: Any, others: Any, blocks: FloatArray) -> None:
    """Copy the blocks (B, 6, 6) above the diagonal to their places below, in place; pattern as in `couple_poses`."""
    below = starts[:-1].astype(np.int64)
    for i in range(len(starts) - 1):
        for e in range(starts[i], starts[i + 1]):
            j = others[e]
            if j > i:  # rows ascend, so those of j are met in their order
                for u in range(POSE):  # assigning blocks compiles for a second
                    for v in range(POSE):
                        blocks[below[j], u, v] = blocks[e, v, u]
                below[j] += 1


@kernel
def couple_cameras(observed: Any, groups: Any, poses: int, damping: float, rows: FloatArray) -> None:
    """Add up the rows of the cameras, in place.

    Args:
        observed: (N,) photo, camera and point; derivatives as in `couple_poses`.
        groups: (N,) group of the observations of a point by one camera; (G,) their cameras; first group of each point;
            (G, 3, 12) zeros.
        poses: columns of the poses, before those of the cameras.
        rows: (12C, 6I + 12C), zeros at first.
    """
    photo, camera, point, by_view, A = observed
    group, camera_of, starts, sums = groups
    for u in range(len(rows)):
        rows[u, poses + u] += damping
    for k in range(len(photo)):
        first, column = CAMERA * camera[k], POSE * photo[k]
        for u in range(CAMERA):
            x, y = by_view[k, 0, POSE + u], by_view[k, 1, POSE + u]
            for v in range(POSE):
                rows[first + u, column + v] += x * by_view[k, 0, v] + y * by_view[k, 1, v]
            for v in range(CAMERA):
                rows[first + u, poses + first + v] += x * by_view[k, 0, POSE + v] + y * by_view[k, 1, POSE + v]
            for axis in range(3):
                sums[group[k], axis, u] += A[k, axis, POSE + u]
    eliminate_from_cameras(photo, point, A, camera_of, starts, sums, poses, rows)


@kernel
def eliminate_from_cameras(  # noqa: PLR0913 -- a kernel
    photo: IndexArray, point: IndexArray, A: FloatArray, camera_of: IndexArray, starts: IndexArray, sums: FloatArray,
    poses: int, rows: FloatArray,
) -> None:  # fmt: skip
    """Remove the parts of all points from the rows of the cameras, in place; arguments as in `couple_cameras`."""
    for k in range(len(photo)):
        column = POSE * photo[k]
        for g in range(starts[point[k]], starts[point[k] + 1]):
            first = CAMERA * camera_of[g]
            for u in range(CAMERA):
                for v in range(POSE):
                    for axis in range(3):
                        rows[first + u, column + v] -= sums[g, axis, u] * A[k, axis, v]
    for p in range(len(starts) - 1):
        for g in range(starts[p], starts[p + 1]):
            for h in range(starts[p], starts[p + 1]):
                first, second = CAMERA * camera_of[g], poses + CAMERA * camera_of[h]
                for u in range(CAMERA):
                    for v in range(CAMERA):
                        for axis in range(3):
                            rows[first + u, second + v] -= sums[g, axis, u] * sums[h, axis, v]


@kernel
def add_scores(observed: Any, response: FloatArray, residue: FloatArray, points: int, scores: FloatArray) -> None:
    """Add up the scores of each photo, in place, one parameter after the other.

    Args:
        observed: (N,) photo, camera and point; (N, 2, 18) and (N, 2, 3) derivatives by view and point.
        response: (12C, 6I) decrease of the best change of the poses.
        residue: (N, 2) residuals.
        scores: (12C, I), zeros at first.
    """
    photo, camera, point, by_view, by_point = observed
    change = np.empty((len(photo), 2))
    for column in range(len(response)):
        own, place = column // CAMERA, POSE + column % CAMERA
        along = np.zeros((points, 3))
        for k in range(len(photo)):
            for row in range(2):
                total = by_view[k, row, place] if camera[k] == own else 0.0
                for v in range(POSE):
                    total -= by_view[k, row, v] * response[column, POSE * photo[k] + v]
                change[k, row] = total
                for axis in range(3):
                    along[point[k], axis] += by_point[k, row, axis] * total
        for k in range(len(photo)):
            for row in range(2):
                rest = change[k, row]
                for axis in range(3):
                    rest -= by_point[k, row, axis] * along[point[k], axis]
                scores[column, photo[k]] += rest * residue[k, row]


@dataclass(frozen=True, slots=True, eq=False)
class Bundle:
    """Cameras, posed photos, points, and observations of the points."""

    params: FloatArray
    """(C, 12) parameters as in `camera.projection`: fx, fy, cx, cy in pixels, k1, k2, p1, p2, ..."""
    camera: NDArray[np.int64]
    """(I,) row of the camera of each photo."""
    R: FloatArray
    t: FloatArray
    """(I, 3, 3) rotations and (I, 3) translations, camera from world."""
    X: FloatArray
    """(P, 3) points."""
    photo: NDArray[np.int64]
    point: NDArray[np.int64]
    """(N,) rows of the photo and the point of each observation."""
    x: FloatArray
    """(N, 2) observed positions, in pixels."""
    family: NDArray[np.int64]
    """(C,) PERSPECTIVE, FISHEYE or PANORAMA of `camera.projection`."""
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
    observed: Linearized
    whiten: FloatArray
    """(P, 3, 3) from `whiten_points`."""
    lost: int
    """Number of lost observations: behind their camera, or not finite."""
    scores: FloatArray
    """(I, 12C) contributions of each photo to g, with poses and points eliminated; they add up to g."""
    open_points: int
    """Number of undetermined points: at infinity, or seen from one position only."""

    def back_substitute(self, cameras: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the best changes of poses (I, 6) and points (P, 3) for a given change of the cameras (C, 12)."""
        poses = self.pose_step - np.einsum("ij,j->i", self.pose_response, cameras.ravel())
        follow = _unwhiten(self.whiten, self.observed.sum_by_point(self.observed.move(poses, cameras.ravel())))
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


def predict(bundle: Bundle) -> FloatArray:
    """Return the predictions of `project` (N, 2), without derivatives."""
    rows = bundle.camera[bundle.photo]
    rotated = np.einsum("nij,nj->ni", bundle.R[bundle.photo], bundle.X[bundle.point])
    return image_points(rotated + bundle.t[bundle.photo], bundle.params[rows], bundle.family[rows])


def residuals(bundle: Bundle, predicted: FloatArray) -> FloatArray:
    """Return observed less predicted positions (N, 2), in pixels; in panoramas the short way round."""
    rows = bundle.camera[bundle.photo]
    return wrap_residuals(bundle.x - predicted, bundle.params[rows], bundle.family[rows])


def reduce(bundle: Bundle, scale_px: float) -> ReducedSystem:
    """Eliminate points, then poses (Schur complement), in the Gauss-Newton approximation.

    The covariance of the cameras is noise^2 H^-1. It is accurate where poses and points minimize the cost. The loss is
    COLMAP's SOFT_L1, s^2 (sqrt(1 + |r|^2 / s^2) - 1), with s = `scale_px`.
    """
    from scipy import sparse

    with np.errstate(all="ignore"):
        predicted, by_camera, by_pose, by_point = project(bundle)
        r, by_view = residuals(bundle, predicted), np.concatenate([by_pose, by_camera], 2)
    # points behind their camera, or in its principal plane, would distort everything near them
    r, by_view, by_point, used = weigh(r, by_view, by_point, usable_mask(bundle, r), scale_px)
    whiten, rank = whiten_points(by_point, bundle.point, len(bundle.X))
    by_point = np.einsum("nki,nji->nkj", by_point, whiten[bundle.point])
    counts = len(bundle.R), len(bundle.params), len(bundle.X)
    observed = Linearized(bundle.photo, bundle.camera[bundle.photo], bundle.point, by_view, by_point, counts)
    poses, cameras = POSE * len(bundle.R), CAMERA * len(bundle.params)
    S, by_camera = eliminate_points(observed, REDUCTION.damping)
    rest = observed.drop_points(r)
    gradient = observed.sum_by_view(rest)
    free = free_pose_columns(bundle.R, bundle.t)
    right = np.column_stack([by_camera[:, free].T, gradient[free]])
    response = solve_sparse_positive(sparse.csr_array(S[free][:, free]), right)
    across = np.einsum("ij,jk->ik", by_camera[:, free], response)
    H, g = by_camera[:, poses:] - across[:, :-1], gradient[poses:] - across[:, -1]
    H = project_to_psd(0.5 * (H + H.T), observed.camera_squares())
    step = solve_positive(H, g[:, None])[:, 0]
    explained = np.sum(gradient[free] * response[:, -1]) + np.sum(g * step)
    squares = max(float(np.sum(rest**2) - explained), 0.0) + REDUCTION.usual_count * REDUCTION.usual_noise_px**2
    redundancy = (
        max(2 * int(np.count_nonzero(used)) - int(np.sum(rank)) - len(free) - cameras, 0) + REDUCTION.usual_count
    )
    pose_step, pose_response = np.zeros(poses), np.zeros((poses, cameras))
    pose_step[free], pose_response[free] = response[:, -1], response[:, :-1]
    residue = rest - observed.drop_points(observed.move(pose_step, np.zeros(cameras)))
    return ReducedSystem(
        H=H,
        g=g,
        noise_px=float(np.sqrt(squares / redundancy)),
        pose_step=pose_step,
        pose_response=pose_response,
        point_step=_unwhiten(whiten, observed.sum_by_point(r)).ravel(),
        observed=observed,
        whiten=whiten,
        lost=len(used) - int(np.count_nonzero(used)),
        scores=observed.score(pose_response, residue),
        open_points=int(np.count_nonzero(rank < 3)),
    )


def _unwhiten(whiten: FloatArray, points: FloatArray) -> FloatArray:
    """Return shifts (P, 3) of points from shifts of the whitened points."""
    return np.asarray(np.einsum("pji,pj->pi", whiten, points), np.float64)


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


def cost(bundle: Bundle, scale_px: float) -> float:
    """Return half the sum of the loss of `reduce`; lost observations count with a residual of `lost_px`."""
    with np.errstate(all="ignore"):
        r = residuals(bundle, predict(bundle))
    return loss(r, usable_mask(bundle, r), scale_px)


def loss(r: FloatArray, usable: NDArray[np.bool_], scale_px: float) -> float:
    """Return half the sum of the loss of `reduce` over residuals (N, 2) in px^2; lost ones count `lost_px`."""
    with np.errstate(all="ignore"):
        squares = np.where(usable, np.einsum("ni,ni->n", r, r), REDUCTION.lost_px**2)
    return float(scale_px**2 * np.sum(np.sqrt(1.0 + squares / scale_px**2) - 1.0))


def usable_mask(bundle: Bundle, r: FloatArray, depth: FloatArray | None = None) -> NDArray[np.bool_]:
    """Return the mask (N,) of observations of points in front of their camera, with residuals below `lost_px`.

    A panorama also sees points behind it. Without depths (N,) before the cameras, they come from the poses.
    """
    with np.errstate(all="ignore"):
        if depth is None:
            depth = np.einsum("nj,nj->n", bundle.R[bundle.photo, 2], bundle.X[bundle.point]) + bundle.t[bundle.photo, 2]
        ahead = (depth > 0.0) | (bundle.family[bundle.camera[bundle.photo]] == PANORAMA)
        return np.asarray(ahead & (np.abs(r) < REDUCTION.lost_px).all(axis=1), np.bool_)


def lost_points(bundle: Bundle) -> NDArray[np.bool_]:
    """Return the mask (P,) of points with a lost observation."""
    with np.errstate(all="ignore"):
        r = residuals(bundle, predict(bundle))
    return np.bincount(bundle.point[~usable_mask(bundle, r)], minlength=len(bundle.X)) > 0


def weigh(
    r: FloatArray, by_view: FloatArray, by_point: FloatArray, usable: NDArray[np.bool_], scale_px: float
) -> tuple[FloatArray, FloatArray, FloatArray, NDArray[np.bool_]]:
    """Return weighted residuals (N, 2), derivatives (N, 2, k) and (N, 2, 3), and the mask (N,) of used ones, else 0."""
    with np.errstate(all="ignore"):
        largest = np.maximum(np.abs(by_view).max(axis=(1, 2), initial=0.0), np.abs(by_point).max(axis=(1, 2)))
        used = usable & (largest < REDUCTION.max_derivative)
    r, by_view, by_point = (np.where(used.reshape(-1, *[1] * (a.ndim - 1)), a, 0.0) for a in (r, by_view, by_point))
    root = (1.0 + np.einsum("ni,ni->n", r, r) / scale_px**2) ** -0.25
    return r * root[:, None], by_view * root[:, None, None], by_point * root[:, None, None], used
