"""Unit vectors, rotations, and similarities."""

from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sfm_app.errors import NumericalError
from sfm_app.jit import kernel
from sfm_app.numerical import MAD_TO_SIGMA
from sfm_app.types.arrays import FloatArray

# Directions in space: unit vectors and the angles between them.


def normalize(vectors: ArrayLike) -> FloatArray:
    """Return vectors (..., 3) with length 1; those of length 0 stay 0."""
    values = np.asarray(vectors, np.float64)
    length = np.linalg.norm(values, axis=-1, keepdims=True)
    return np.asarray(np.divide(values, length, out=np.zeros_like(values), where=length > 0), np.float64)


def axis_angle_deg(first: ArrayLike, second: ArrayLike) -> FloatArray:
    """Return the angle between the lines along vectors, ignoring their signs, in degrees in [0, 90].

    Args:
        first: (..., 3) vectors of any length but zero.
        second: (..., 3) likewise; the two are broadcast.
    """
    a, b = normalize(first), normalize(second)
    # the cross product keeps its digits where the arc cosine loses them
    sine = np.linalg.norm(np.cross(a, b), axis=-1)
    return np.asarray(np.degrees(np.arctan2(sine, np.abs((a * b).sum(axis=-1)))))


def component_along(vectors: FloatArray, axis: FloatArray) -> FloatArray:
    """Return the components (N,) of vectors along an axis, without BLAS, whose rounding depends on its threads.

    Args:
        vectors: (N, 3).
        axis: (3,), of length 1 for components in the unit of the vectors.
    """
    return np.asarray(np.einsum("ni,i->n", vectors, axis))


def perpendicular_component(vector: ArrayLike, axis: FloatArray) -> FloatArray:
    """Return the component of vectors perpendicular to an axis.

    Args:
        vector: (..., 3) one vector or many.
        axis: (3,) unit vector.
    """
    values = np.asarray(vector, np.float64)
    return np.asarray(values - (values @ axis)[..., None] * axis)


def perpendicular_basis(axis: FloatArray) -> FloatArray:
    """Return orthonormal rows e1, e2 (2, 3) with e1 x e2 = axis, a unit vector (3,)."""
    least = np.eye(3)[int(np.argmin(np.abs(axis)))]
    e1 = normalize(perpendicular_component(least, axis))
    return np.stack([e1, np.cross(axis, e1)])


def smallest_eigenvector(matrix: FloatArray, like: FloatArray) -> FloatArray:
    """Return the eigenvector (3,) of the smallest eigenvalue.

    Args:
        matrix: (3, 3), symmetric.
        like: (3,) direction; the sign of the result is such that their dot product is not negative.
    """
    found: FloatArray = np.linalg.eigh(matrix)[1][:, 0]
    return found if found @ like >= 0 else -found


# Relative poses for kernels: twelve numbers, R by rows and then the unit vector t; five degrees of freedom.

POSE_DOF = 5
"""Parameters of a relative pose: three of rotation, two of direction. Counted."""


@kernel
def write_essential(pose: FloatArray, E: FloatArray) -> None:
    """Write the essential matrix [t]x R of a pose.

    Args:
        pose: (12,) R by rows, then the unit vector t.
        E: (3, 3), written to.
    """
    x, y, z = pose[9], pose[10], pose[11]
    for j in range(3):
        E[0, j] = y * pose[6 + j] - z * pose[3 + j]
        E[1, j] = z * pose[j] - x * pose[6 + j]
        E[2, j] = x * pose[3 + j] - y * pose[j]


@kernel
def retract(pose: FloatArray, step: FloatArray) -> FloatArray:
    """Return the pose (12,) after a step: R turned by exp([w]x), t moved in its tangent plane.

    Args:
        pose: (12,) R by rows, then the unit vector t.
        step: (5,) w in radians, then the move of t along two unit vectors perpendicular to it.
    """
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


# Similarities between two sets of points in space: scale, rotation, translation.

MAX_TRIPLES = 500
"""Triples of points that are tried. Chosen by hand; halved and doubled by `benchmarks.sensitivity`."""
MOST_LISTED = 60
"""Most points whose triples are all listed before some are drawn; a thousand points have 166 million. Chosen by hand;
halved and doubled by `benchmarks.sensitivity`."""


@dataclass(frozen=True, slots=True, eq=False)
class Similarity:
    """x -> scale R x + t."""

    scale: float
    R: FloatArray
    """(3, 3) rotation."""
    t: FloatArray
    """(3,)."""

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
    """Fit the similarity that maps points to others with least squared error (Umeyama 1991).

    Args:
        a: (N, 3) points, N >= 3.
        b: (N, 3) points that they should map to, row by row.
    """
    mean_a, mean_b = a.mean(axis=0), b.mean(axis=0)
    u, s, vt = np.linalg.svd((b - mean_b).T @ (a - mean_a))
    signs = np.array([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
    R = (u * signs) @ vt
    scale = float((s * signs).sum() / ((a - mean_a) ** 2).sum())
    return Similarity(scale, R, mean_b - scale * R @ mean_a)


def robust_similarity(a: FloatArray, b: FloatArray) -> Similarity:
    """Fit the similarity that maps most of the points to others, robust to wrong ones.

    Least median of squares over triples, then Umeyama on the points that agree with the best triple (Rousseeuw 1984;
    the threshold is 2.5 robust standard deviations).

    Args:
        a: (N, 3) points.
        b: (N, 3) points that they should map to, row by row; some may be wrong.

    Raises:
        NumericalError: fewer than 3 points, or all lie on a line.
    """
    count = len(a)
    triples = _triples(count)
    best, residual = np.inf, np.zeros(count)
    for triple in triples:
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


def _triples(count: int) -> NDArray[np.intp]:
    """List all triples of `count` points, or `MAX_TRIPLES` of them, drawn with a fixed seed."""
    rng = np.random.default_rng(0)
    if count > MOST_LISTED:
        return np.array([rng.choice(count, 3, replace=False) for _ in range(MAX_TRIPLES)], np.intp)
    triples = np.array(list(combinations(range(count), 3)), np.intp).reshape(-1, 3)
    return rng.permutation(triples)[:MAX_TRIPLES] if len(triples) > MAX_TRIPLES else triples


def _is_collinear(points: FloatArray) -> bool:
    s = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    return bool(s[1] <= max(1e-6 * s[0], 1e-140))  # squares of less are zero
