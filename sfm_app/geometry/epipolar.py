"""The epipolar geometry of two views: the 8-point algorithm, and quantities that follow from F.

``x2' F x1 = 0`` throughout. Points are (N, 2) pixels. Hartley and Zisserman, Multiple View Geometry, 2nd edition (HZ).
"""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sfm_app.errors import NumericalError

FloatArray = NDArray[np.float64]


def to_homogeneous(x: ArrayLike) -> FloatArray:
    """Return (N, 2) points as (N, 3) with a last coordinate of 1; ValueError for any other shape."""
    points = np.asarray(x, dtype=np.float64)
    if points.ndim != 2 or points.shape[1] != 2:
        raise ValueError(f"points must have shape (N, 2), got {points.shape}")
    return np.column_stack([points, np.ones(len(points))])


def homogeneous_pair(x1: ArrayLike, x2: ArrayLike) -> tuple[FloatArray, FloatArray]:
    """Return both views of N matches as (N, 3).

    Args:
        x1: (N, 2) points.
        x2: (N, 2) points, row by row the partners of x1.

    Raises:
        ValueError: other shapes, or rows that do not pair up.
    """
    h1, h2 = to_homogeneous(x1), to_homogeneous(x2)
    if len(h1) != len(h2):
        raise ValueError(f"x1 and x2 must pair up, got {len(h1)} and {len(h2)} points")
    return h1, h2


def hartley_normalization(x: ArrayLike) -> FloatArray:
    """Return the (3, 3) similarity that puts the centroid at 0 and the mean distance from it at sqrt(2).

    Raises:
        NumericalError: no points, or all of them coincide.
    """
    points = to_homogeneous(x)[:, :2]
    if not len(points):
        raise NumericalError("no points to normalize")
    center = points.mean(axis=0)
    spread = float(np.hypot(*(points - center).T).mean())
    if not spread > 1e-9 * max(1.0, float(np.abs(center).max())):
        raise NumericalError("all points coincide")
    scale = np.sqrt(2) / spread
    return np.array([[scale, 0, -scale * center[0]], [0, scale, -scale * center[1]], [0, 0, 1]])


def eight_point(x1: ArrayLike, x2: ArrayLike, weights: ArrayLike | None = None) -> FloatArray:
    """Estimate F by the normalized 8-point algorithm (thesis 4.3.2): algebraic least squares, then the nearest rank 2.

    Args:
        x1: (N, 2) pixels, N >= 8.
        x2: (N, 2) pixels, the partners.
        weights: (N,) >= 0, how much each squared algebraic error counts; all 1 if None.

    Returns:
        (3, 3), rank 2, Frobenius norm 1. If the matches do not determine F (all on one plane), one of the solutions.

    Raises:
        ValueError: wrong shapes.
        NumericalError: fewer than 8 matches, or all points of a view coincide.
    """
    h1, h2 = homogeneous_pair(x1, x2)
    if len(h1) < 8:
        raise NumericalError(f"the 8-point algorithm needs 8 matches, got {len(h1)}")
    T1, T2 = hartley_normalization(h1[:, :2]), hartley_normalization(h2[:, :2])
    h1, h2 = h1 @ T1.T, h2 @ T2.T
    design = (h2[:, :, None] * h1[:, None, :]).reshape(-1, 9)
    if weights is not None:
        design *= np.sqrt(np.asarray(weights, dtype=np.float64))[:, None]
    # all of V is wanted, but not all of U, which is as large as the number of matches squared
    F = np.linalg.svd(design, full_matrices=len(design) < 9)[2][8].reshape(3, 3)
    return to_unit_norm(T2.T @ nearest_rank_two(F) @ T1)


def nearest_rank_two(F: ArrayLike) -> FloatArray:
    """Return the matrix of rank 2 that is nearest to F in the Frobenius norm (thesis 4.2)."""
    U, s, Vt = np.linalg.svd(np.asarray(F, dtype=np.float64))
    rank_two: FloatArray = (U[:, :2] * s[:2]) @ Vt[:2]
    return rank_two


def to_unit_norm(F: ArrayLike) -> FloatArray:
    """Return F with Frobenius norm 1 and its entry of largest magnitude positive.

    Raises:
        NumericalError: F is zero or not finite.
    """
    matrix = np.asarray(F, dtype=np.float64)
    norm = float(np.linalg.norm(matrix))
    if not (np.isfinite(norm) and norm > 0):
        raise NumericalError("F is zero or not finite")
    largest = matrix.flat[int(np.argmax(np.abs(matrix)))]
    return matrix / (norm if largest > 0 else -norm)


def epipoles(F: ArrayLike) -> tuple[FloatArray, FloatArray]:
    """Return homogeneous unit vectors e1, e2 with F e1 = 0 and F' e2 = 0: each camera center seen by the other."""
    U, _, Vt = np.linalg.svd(np.asarray(F, dtype=np.float64))
    return Vt[2], U[:, 2]


def canonical_cameras(F: ArrayLike) -> tuple[FloatArray, FloatArray]:
    """Return cameras with this F, P1 = [I|0] and P2 = [[e2]x F + e2 v' | e2] (thesis 2.34 with lambda = 1, HZ 9.10).

    v is free: it selects the plane of the scene that lies at infinity. With F of norm 1, singular values s1 >= s2, and
    v = sqrt(s1 s2) e1 the left 3 x 3 of P2 has the singular values s1, sqrt(s1 s2), s2: invertible, and as well
    conditioned as F lets it be. In pixels s1 / s2 is large: pass the F of centered points with coordinates near 1.

    Args:
        F: (3, 3), rank 2, any scale.

    Returns:
        P1, P2, both (3, 4), x1 ~ P1 X and x2 ~ P2 X.

    Raises:
        NumericalError: F is zero or not finite.
    """
    F = to_unit_norm(F)
    e1, e2 = epipoles(F)
    s = np.linalg.svd(F, compute_uv=False)
    M = cross_matrix(e2) @ F + np.outer(e2, np.sqrt(s[0] * s[1]) * e1)
    return np.eye(3, 4), np.column_stack([M, e2])


def cross_matrix(v: ArrayLike) -> FloatArray:
    """Return the (3, 3) matrix [v]x with [v]x w = v x w."""
    a, b, c = np.asarray(v, dtype=np.float64)
    return np.array([[0, -c, b], [c, 0, -a], [-b, a, 0]])


def fundamental_from_pose(K1: ArrayLike, K2: ArrayLike, R: ArrayLike, t: ArrayLike) -> FloatArray:
    """Return F of two cameras with x1 ~ K1 X and x2 ~ K2 (R X + t) (HZ 9.12), Frobenius norm 1.

    Args:
        K1: (3, 3) camera matrix of view 1.
        K2: (3, 3) camera matrix of view 2.
        R: (3, 3) rotation of view 2 from view 1.
        t: (3,) translation, any length but zero.

    Raises:
        NumericalError: t is zero: without a baseline there is no epipolar geometry.
    """
    K1, K2, R = (np.asarray(m, dtype=np.float64) for m in (K1, K2, R))
    return to_unit_norm(np.linalg.inv(K2).T @ cross_matrix(t) @ R @ np.linalg.inv(K1))
