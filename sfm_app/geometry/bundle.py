"""What all observations of a model together say about its cameras, with poses and points eliminated."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.spatial.transform import Rotation

from sfm_app.geometry.positive import solve_positive

FloatArray = NDArray[np.float64]

FX, FY, CX, CY, K1, K2, P1, P2 = range(8)
"""Places in the parameters of a camera: those of COLMAP's OPENCV."""
LEAST = 1e-6
"""Added to the diagonal: a photo without an observation left has no place, but is no reason to fail."""
CAMERA, POSE = 8, 6
"""Numbers of parameters of a camera and of a pose."""


@dataclass(frozen=True, slots=True, eq=False)
class Bundle:
    """Cameras, posed photos, points, and where the points were seen."""

    params: FloatArray
    """(C, 8) fx, fy, cx, cy in pixels, k1, k2, p1, p2."""
    camera: NDArray[np.int64]
    """(I,) row of the camera that took a photo."""
    R: FloatArray
    """(I, 3, 3) rotations, camera from world."""
    t: FloatArray
    """(I, 3) translations, camera from world."""
    X: FloatArray
    """(P, 3) points."""
    photo: NDArray[np.int64]
    """(N,) row of the photo of an observation."""
    point: NDArray[np.int64]
    """(N,) row of its point."""
    x: FloatArray
    """(N, 2) where it was seen, in pixels."""


@dataclass(frozen=True, slots=True, eq=False)
class Reduced:
    """The cost about the cameras as they are, poses and points giving way: cost - g'd + d'Hd / 2."""

    H: FloatArray
    """(8C, 8C) in the order of `Bundle.params`."""
    g: FloatArray
    """(8C,)"""
    noise_px: float
    """Standard deviation of a coordinate, from what the best linear step leaves over."""
    pose_step: FloatArray
    """(6I,) best change of the poses when the cameras stay."""
    pose_give: FloatArray
    """(6I, 8C) how much less they change per change of the cameras."""
    point_step: FloatArray
    """(3P,) best change of the points when all else stays."""
    point_give: sparse.csr_array
    """(3P, 6I + 8C) how much less they change per change of poses and cameras."""

    def follow(self, cameras: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Changes of poses (I, 6) and points (P, 3) that go best with a change of the cameras (C, 8)."""
        poses = self.pose_step - np.einsum("ij,j->i", self.pose_give, cameras.ravel())
        points = self.point_step - self.point_give @ np.concatenate([poses, cameras.ravel()])
        return poses.reshape(-1, POSE), points.reshape(-1, 3)


def project(bundle: Bundle) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Predictions (N, 2), and their derivatives by camera (N, 2, 8), pose (N, 2, 6) and point (N, 2, 3).

    Poses change by a rotation vector about the world's axes turned into the camera, and by a shift of t.
    """
    fx, fy, cx, cy, k1, k2, p1, p2 = bundle.params[bundle.camera[bundle.photo]].T
    R = bundle.R[bundle.photo]
    turned = np.einsum("nij,nj->ni", R, bundle.X[bundle.point])
    X, Y, Z = (turned + bundle.t[bundle.photo]).T
    u, v = X / Z, Y / Z
    r2 = u * u + v * v
    gain, slope = k1 * r2 + k2 * r2 * r2, k1 + 2.0 * k2 * r2
    ud = u + u * gain + 2.0 * p1 * u * v + p2 * (r2 + 2.0 * u * u)
    vd = v + v * gain + 2.0 * p2 * u * v + p1 * (r2 + 2.0 * v * v)
    nil, one = np.zeros_like(u), np.ones_like(u)
    by_camera = np.stack(
        [
            np.stack([ud, nil, one, nil, fx * u * r2, fx * u * r2 * r2, 2 * fx * u * v, fx * (r2 + 2 * u * u)], -1),
            np.stack([nil, vd, nil, one, fy * v * r2, fy * v * r2 * r2, fy * (r2 + 2 * v * v), 2 * fy * u * v], -1),
        ],
        1,
    )
    cross = 2.0 * (u * v * slope + p1 * u + p2 * v)
    uu = 1.0 + gain + 2.0 * u * u * slope + 2.0 * p1 * v + 6.0 * p2 * u
    vv = 1.0 + gain + 2.0 * v * v * slope + 2.0 * p2 * u + 6.0 * p1 * v
    by_uv = np.stack([np.stack([fx * uu, fx * cross], -1), np.stack([fy * cross, fy * vv], -1)], 1)
    uv_by_x = np.stack([np.stack([one, nil, -u], -1), np.stack([nil, one, -v], -1)], 1) / Z[:, None, None]
    by_x = np.einsum("nij,njk->nik", by_uv, uv_by_x)
    by_pose = np.concatenate([np.cross(turned[:, None], by_x), by_x], 2)
    predicted = np.stack([fx * ud + cx, fy * vd + cy], -1)
    return predicted, by_camera, by_pose, np.einsum("nij,njk->nik", by_x, R)


def reduce(bundle: Bundle, scale_px: float) -> Reduced:
    """Eliminate points, then poses (Schur's complement), in Gauss and Newton's approximation.

    The covariance of the cameras is noise^2 H^-1.

    Args:
        bundle: the model; what it says about the cameras is right where poses and points fit best.
        scale_px: s of the loss s^2 (sqrt(1 + |r|^2 / s^2) - 1), which is COLMAP's SOFT_L1.
    """
    predicted, by_camera, by_pose, by_point = project(bundle)
    r = bundle.x - predicted
    root = (1.0 + np.einsum("ni,ni->n", r, r) / scale_px**2) ** -0.25
    r, by_point = r * root[:, None], by_point * root[:, None, None]
    by_view = np.concatenate([by_pose, by_camera], 2) * root[:, None, None]
    whiten = _whiten(by_point, bundle.point, len(bundle.X))
    by_point = np.einsum("nki,nji->nkj", by_point, whiten[bundle.point])
    poses, cameras = POSE * len(bundle.R), CAMERA * len(bundle.params)
    columns = np.hstack(
        [
            POSE * bundle.photo[:, None] + np.arange(POSE),
            poses + CAMERA * bundle.camera[bundle.photo][:, None] + np.arange(CAMERA),
        ]
    )
    J = _sparse(by_view, columns, poses + cameras)
    Jp = _sparse(by_point, 3 * bundle.point[:, None] + np.arange(3), 3 * len(bundle.X))
    A = (Jp.T @ J).tocsr()
    S = (J.T @ J - A.T @ A).toarray() + LEAST * np.eye(poses + cameras)
    flat = r.ravel()
    along = Jp.T @ flat
    gradient = J.T @ flat - A.T @ along
    free = _gauge(bundle)
    give = solve_positive(S[np.ix_(free, free)], np.column_stack([S[free][:, poses:], gradient[free]]))
    across = np.einsum("ij,jk->ik", S[poses:][:, free], give)
    H, g = S[poses:, poses:] - across[:, :-1], gradient[poses:] - across[:, -1]
    H = 0.5 * (H + H.T)
    step = solve_positive(H, g[:, None])[:, 0]
    explained = np.sum(along**2) + np.sum(gradient[free] * give[:, -1]) + np.sum(g * step)
    spare = max(len(flat) - 3 * len(bundle.X) - len(free) - cameras, 1)
    pose_step, pose_give = np.zeros(poses), np.zeros((poses, cameras))
    pose_step[free], pose_give[free] = give[:, -1], give[:, :-1]
    unwhiten = _block_diagonal(whiten.transpose(0, 2, 1))
    return Reduced(
        H=H,
        g=g,
        noise_px=float(np.sqrt(max(np.sum(flat**2) - explained, 0.0) / spare)),
        pose_step=pose_step,
        pose_give=pose_give,
        point_step=unwhiten @ along,
        point_give=unwhiten @ A,
    )


def moved(bundle: Bundle, params: FloatArray, poses: FloatArray, points: FloatArray) -> Bundle:
    """The bundle with other cameras (C, 8), and with changed poses (I, 6) and points (P, 3)."""
    R = Rotation.from_rotvec(poses[:, :3]).as_matrix() @ bundle.R
    return replace(bundle, params=params, R=R, t=bundle.t + poses[:, 3:], X=bundle.X + points)


def cost(bundle: Bundle, scale_px: float) -> float:
    """Half the sum of the loss of `reduce`."""
    r = bundle.x - project(bundle)[0]
    return float(scale_px**2 * np.sum(np.sqrt(1.0 + np.einsum("ni,ni->n", r, r) / scale_px**2) - 1.0))


def _whiten(by_point: FloatArray, point: NDArray[np.int64], points: int) -> FloatArray:
    """(P, 3, 3) W such that the derivatives by W^-T X are orthonormal over the observations of a point."""
    H = np.zeros((points, 3, 3))
    products = np.einsum("nki,nkj->nij", by_point, by_point)
    for i in range(3):
        for j in range(3):
            H[:, i, j] = np.bincount(point, products[:, i, j], points)
    return np.asarray(np.linalg.inv(np.linalg.cholesky(H)), np.float64)


def _block_diagonal(blocks: FloatArray) -> sparse.csr_array:
    """(3P, 3P) from (P, 3, 3)."""
    P = len(blocks)
    columns = np.repeat(3 * np.arange(P)[:, None] + np.arange(3), 3, axis=0)
    return sparse.csr_array((blocks.ravel(), columns.ravel(), 3 * np.arange(3 * P + 1)), shape=(3 * P, 3 * P))


def _gauge(bundle: Bundle) -> NDArray[np.int64]:
    """Columns of the poses that are free when the first photo stays, and the distance to the photo farthest from it."""
    centres = -np.einsum("nji,nj->ni", bundle.R, bundle.t)
    far = int(np.argmax(np.linalg.norm(centres - centres[0], axis=1)))
    relative = bundle.R[far] @ (centres[0] - centres[far])
    held = {POSE * far + 3 + int(np.argmax(np.abs(relative)))} | set(range(POSE))
    return np.array([k for k in range(POSE * len(bundle.R)) if k not in held])


def _sparse(blocks: FloatArray, columns: NDArray[np.int64], width: int) -> sparse.csr_array:
    """(2N, width) from (N, 2, k) blocks that stand in the same k columns (N, k) of two rows each."""
    N, _, k = blocks.shape
    places = np.repeat(columns, 2, axis=0).ravel()
    return sparse.csr_array((blocks.ravel(), places, k * np.arange(2 * N + 1)), shape=(2 * N, width))
