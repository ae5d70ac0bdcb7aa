"""Unit vectors, rotations, and similarities."""

from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sfm_app.errors import NumericalError
from sfm_app.geometry.epipolar import FIRST, SECOND, depths
from sfm_app.jit import kernel
from sfm_app.numerical import MAD_TO_SIGMA
from sfm_app.types.arrays import BoolArray, FloatArray


def normalize(vectors: ArrayLike) -> FloatArray:
    """Return vectors (..., 3) with length 1; those of length 0 stay 0."""
    values = np.asarray(vectors, np.float64)
    length = np.linalg.norm(values, axis=-1, keepdims=True)
    return np.asarray(np.divide(values, length, out=np.zeros_like(values), where=length > 0), np.float64)


def axis_angle_deg(first: ArrayLike, second: ArrayLike) -> FloatArray:
    """Return the angle between the lines along vectors (..., 3), ignoring their signs, in degrees in [0, 90]."""
    a, b = normalize(first), normalize(second)
    # the cross product keeps its digits where the arc cosine loses them
    sine = np.linalg.norm(np.cross(a, b), axis=-1)
    return np.asarray(np.degrees(np.arctan2(sine, np.abs((a * b).sum(axis=-1)))))


def component_along(vectors: FloatArray, axis: FloatArray) -> FloatArray:
    """Return the components (N,) of vectors (N, 3) along an axis; without BLAS, whose rounding depends on threads."""
    return np.asarray(np.einsum("ni,i->n", vectors, axis))


def perpendicular_component(vector: ArrayLike, axis: FloatArray) -> FloatArray:
    """Return the component of vectors (..., 3) perpendicular to an axis, a unit vector (3,)."""
    values = np.asarray(vector, np.float64)
    return np.asarray(values - (values @ axis)[..., None] * axis)


def perpendicular_basis(axis: FloatArray) -> FloatArray:
    """Return orthonormal rows e1, e2 (2, 3) with e1 x e2 = axis, a unit vector (3,)."""
    least = np.eye(3)[int(np.argmin(np.abs(axis)))]
    e1 = normalize(perpendicular_component(least, axis))
    return np.stack([e1, np.cross(axis, e1)])


def smallest_eigenvector(matrix: FloatArray, like: FloatArray) -> FloatArray:
    """Return the eigenvector (3,) of the smallest eigenvalue of a symmetric matrix, with the sign of `like`."""
    vector: FloatArray = np.linalg.eigh(matrix)[1][:, 0]
    return vector if vector @ like >= 0 else -vector


# Relative poses for kernels: twelve numbers, R by rows and then the unit vector t; five degrees of freedom.

POSE_DOF = 5
"""Parameters of a relative pose: three of rotation, two of direction. Counted."""


@kernel
def write_essential(pose: FloatArray, E: FloatArray) -> None:
    """Write the essential matrix [t]x R (3, 3) of a pose (12,)."""
    x, y, z = pose[9], pose[10], pose[11]
    for j in range(3):
        E[0, j] = y * pose[6 + j] - z * pose[3 + j]
        E[1, j] = z * pose[j] - x * pose[6 + j]
        E[2, j] = x * pose[3 + j] - y * pose[j]


@kernel
def retract(pose: FloatArray, step: FloatArray) -> FloatArray:
    """Return the pose (12,) after a step (5,): R rotated by exp([w]x), t displaced in its tangent plane."""
    wx, wy, wz = step[0], step[1], step[2]
    angle = np.sqrt(wx * wx + wy * wy + wz * wz)
    sine = np.sin(angle) / angle if angle > 1e-12 else 1.0
    versine = (1.0 - np.cos(angle)) / (angle * angle) if angle > 1e-6 else 0.5
    out = np.empty(12)
    for j in range(3):
        a, b, c = pose[j], pose[3 + j], pose[6 + j]
        dot = wx * a + wy * b + wz * c
        cosine = 1.0 - versine * angle * angle
        out[j] = cosine * a + sine * (wy * c - wz * b) + versine * dot * wx
        out[3 + j] = cosine * b + sine * (wz * a - wx * c) + versine * dot * wy
        out[6 + j] = cosine * c + sine * (wx * b - wy * a) + versine * dot * wz
    x, y, z = pose[9], pose[10], pose[11]
    # two unit vectors perpendicular to t (Duff et al. 2017)
    sign = 1.0 if z >= 0.0 else -1.0
    p = -1.0 / (sign + z)
    q = x * y * p
    u, v = step[3], step[4]
    nx = x + u * (1.0 + sign * x * x * p) + v * q
    ny = y + u * sign * q + v * (sign + y * y * p)
    nz = z - u * sign * x - v * y
    length = np.sqrt(nx * nx + ny * ny + nz * nz)
    out[9], out[10], out[11] = nx / length, ny / length, nz / length
    return out


@kernel
def write_nearby_essentials(pose: FloatArray, step: float, Es: FloatArray) -> None:
    """Write E of a pose, and with each of its five parameters a step away, into `Es` (6, 3, 3)."""
    parameters = np.zeros(POSE_DOF)
    write_essential(pose, Es[0])
    for j in range(POSE_DOF):
        parameters[j] = step
        write_essential(retract(pose, parameters), Es[1 + j])
        parameters[j] = 0.0


@kernel
def sampson_of_rays(p: FloatArray, q: FloatArray, E: FloatArray) -> float:
    """Return the signed Sampson distance of a match from its bearing vectors p and q, see `camera.bearings`."""
    l0 = E[0, 0] * p[0] + E[0, 1] * p[1] + E[0, 2] * p[2]
    l1 = E[1, 0] * p[0] + E[1, 1] * p[1] + E[1, 2] * p[2]
    l2 = E[2, 0] * p[0] + E[2, 1] * p[1] + E[2, 2] * p[2]
    k0 = E[0, 0] * q[0] + E[1, 0] * q[1] + E[2, 0] * q[2]
    k1 = E[0, 1] * q[0] + E[1, 1] * q[1] + E[2, 1] * q[2]
    k2 = E[0, 2] * q[0] + E[1, 2] * q[1] + E[2, 2] * q[2]
    g0 = k0 * p[3] + k1 * p[4] + k2 * p[5]
    g1 = k0 * p[6] + k1 * p[7] + k2 * p[8]
    h0 = l0 * q[3] + l1 * q[4] + l2 * q[5]
    h1 = l0 * q[6] + l1 * q[7] + l2 * q[8]
    algebraic = q[0] * l0 + q[1] * l1 + q[2] * l2
    return float(algebraic / np.sqrt(g0 * g0 + g1 * g1 + h0 * h0 + h1 * h1 + 1e-300))


def pose_distances(lines: FloatArray, R: FloatArray, t: FloatArray) -> FloatArray:
    """Return the Sampson distances (N,) in pixels, >= 0, of matches `lines` (N, 18) to a pose with |t| = 1."""
    pose = np.concatenate([R.ravel(), t])
    return np.abs(_distances(lines, pose))


@kernel
def _distances(lines: FloatArray, pose: FloatArray) -> FloatArray:
    E, distances = np.empty((3, 3)), np.empty(lines.shape[0])
    write_essential(pose, E)
    for i in range(lines.shape[0]):
        distances[i] = sampson_of_rays(lines[i, :9], lines[i, 9:], E)
    return distances


def is_in_front(used: FloatArray, R: FloatArray, t: FloatArray) -> BoolArray:
    """Return a mask (N,) of the matches `used` (N, 18) whose points lie in front of both cameras."""
    first, second = depths(used, R, t)
    return (first > 0) & (second > 0)


def explained_mask(lines: FloatArray, R: FloatArray, t: FloatArray, max_error_px: float) -> BoolArray:
    """Return a mask (N,) of the matches (N, 18) that lie on their epipolar lines, in front of both cameras."""
    return (pose_distances(lines, R, t) <= max_error_px) & is_in_front(lines, R, t)


def ray_angles_deg(used: FloatArray, R: FloatArray) -> FloatArray:
    """Return (N,) degrees between the two rays of each match (N, 18): the triangulation angles if t fits."""
    h1, h2 = used[:, FIRST] @ R.T, used[:, SECOND]
    sine = np.linalg.norm(np.cross(h1, h2), axis=1)
    return np.asarray(np.degrees(np.arctan2(sine, (h1 * h2).sum(axis=1))), np.float64)


@dataclass(frozen=True, slots=True, eq=False)
class Similarity:
    """x -> scale R x + t."""

    scale: float
    R: FloatArray
    t: FloatArray

    def __call__(self, points: FloatArray) -> FloatArray:
        """Apply the similarity to points (N, 3)."""
        return np.asarray(self.scale * points @ self.R.T + self.t)

    def compose(self, first: "Similarity") -> "Similarity":
        """Return the similarity that applies `first`, then this one."""
        return Similarity(self.scale * first.scale, self.R @ first.R, self.scale * self.R @ first.t + self.t)

    def inverse(self) -> "Similarity":
        """Return the similarity that undoes this one."""
        return Similarity(1.0 / self.scale, self.R.T, -self.R.T @ self.t / self.scale)


def umeyama(a: FloatArray, b: FloatArray) -> Similarity:
    """Fit the similarity from a to b, (N, 3) with N >= 3, with least squared error (Umeyama 1991)."""
    mean_a, mean_b = a.mean(axis=0), b.mean(axis=0)
    u, s, vt = np.linalg.svd((b - mean_b).T @ (a - mean_a))
    signs = np.array([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
    R = (u * signs) @ vt
    scale = float((s * signs).sum() / ((a - mean_a) ** 2).sum())
    return Similarity(scale, R, mean_b - scale * R @ mean_a)


def robust_similarity(a: FloatArray, b: FloatArray) -> Similarity:
    """Fit the similarity that maps most of the points a (N, 3) to b, robust to wrong ones.

    Least median of squares over triples, then Umeyama on the points within 2.5 robust standard deviations of the best
    triple (Rousseeuw 1984). NumericalError for fewer than 3 points, or if all lie on a line.
    """
    count = len(a)
    best, residual = np.inf, np.zeros(count)
    for triple in _triples(count):
        if _is_collinear(a[triple]) or _is_collinear(b[triple]):
            continue
        distance = np.linalg.norm(umeyama(a[triple], b[triple])(a) - b, axis=1)
        # 3 of the points fit by construction, so the score is the residual one rank above the median
        score = float(np.sort(distance)[min(count - 1, count // 2 + 1)])
        if score < best:
            best, residual = score, distance
    if not np.isfinite(best):
        raise NumericalError("fewer than 3 points, or all on a line: they do not determine a rotation")
    agreeing = residual <= max(2.5 * MAD_TO_SIGMA * best, np.sort(residual)[2])
    return umeyama(a[agreeing], b[agreeing])


def draw_pairs(count: int, most: int) -> NDArray[np.intp]:
    """List all pairs (P, 2) of `count` points, or `most` of them, drawn with a fixed seed."""
    starts = np.cumsum([0, *range(count - 1, 0, -1)])  # numbers of the pairs that begin with each point
    chosen = np.arange(starts[-1])
    if len(chosen) > most:
        chosen = np.random.default_rng(0).permutation(len(chosen))[:most]
    first = np.searchsorted(starts, chosen, side="right") - 1
    return np.column_stack([first, chosen - starts[first] + first + 1]).astype(np.intp)


def _triples(count: int) -> NDArray[np.intp]:
    """List all triples of `count` points, or 500 of them, drawn with a fixed seed."""
    most, rng = 500, np.random.default_rng(0)
    if count > 60:  # too many triples to list them all before some are drawn
        return np.array([rng.choice(count, 3, replace=False) for _ in range(most)], np.intp)
    triples = np.array(list(combinations(range(count), 3)), np.intp).reshape(-1, 3)
    return rng.permutation(triples)[:most] if len(triples) > most else triples


def _is_collinear(points: FloatArray) -> bool:
    s = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    return bool(s[1] <= max(1e-6 * s[0], 1e-140))  # squares of less are zero
