"""Epipolar geometry of two views: F, E, distances, poses and triangulation, for pixels and for rays."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sfm_app.camera.bearings import pixels_per_radian
from sfm_app.errors import NumericalError
from sfm_app.types.arrays import FloatArray

# The epipolar geometry of two views: the 8-point algorithm, and quantities that follow from F.
#
# ``x2' F x1 = 0`` throughout. Points are (N, 2) pixels. Hartley and Zisserman, Multiple View Geometry, 2nd edition
# (HZ).


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


# How far a match is from an epipolar geometry: the four error measures of thesis section 4.2.
#
# Linear fits minimize `algebraic_distance`; `symmetric_epipolar_distance` is measured from points to lines;
# `sampson_distance` is the first-order approximation of `reprojection_distance`, the distance itself: the length of
# the shortest move of both points, in 4D, that makes the match exact. Points are (N, 2) pixels, ``x2' F x1 = 0``.

_EPS = float(np.finfo(float).eps)
"""Spacing of numbers at 1 in double precision."""
_TINY = float(np.finfo(float).tiny)
"""The smallest normal number in double precision."""
_MOST_STEPS = 100
"""Most steps of the root search: bisection alone needs 60, Newton's method 3 to 6. Chosen by hand; halved and doubled
by `benchmarks.sensitivity`."""


def algebraic_distance(F: ArrayLike, x1: ArrayLike, x2: ArrayLike) -> FloatArray:
    """Return |x2' F x1| with F of Frobenius norm 1 and points (x, y, 1): |A b| per match (thesis 2.28 and 4.2).

    Unlike the other distances it has no unit, and it depends on the origin and scale of the coordinates: pass points
    and F in the intended frame, such as that of `hartley_normalization`.

    Args:
        F: (3, 3), any scale.
        x1: (N, 2) points in any frame.
        x2: (N, 2) points, row by row the partners of x1.

    Returns:
        (N,) >= 0; inf where F is zero.

    Raises:
        ValueError: the shapes are not as above.
    """
    algebraic, _, _ = _constraint(F, x1, x2)
    return _ratio(np.abs(algebraic), np.full(len(algebraic), np.linalg.norm(np.asarray(F, dtype=np.float64))))


def symmetric_epipolar_distance(F: ArrayLike, x1: ArrayLike, x2: ArrayLike) -> FloatArray:
    """Return the root mean square of a match's distances to its two epipolar lines (HZ 11.10, thesis 4.1).

    Args:
        F: (3, 3), any scale.
        x1: (N, 2) pixels.
        x2: (N, 2) pixels, row by row the partners of x1.

    Returns:
        (N,) distances in pixels, >= 0; inf where an epipolar line vanishes.

    Raises:
        ValueError: the shapes are not as above.
    """
    algebraic, line1, line2 = _constraint(F, x1, x2)
    to1 = _ratio(np.abs(algebraic), np.hypot(line1[:, 0], line1[:, 1]))
    to2 = _ratio(np.abs(algebraic), np.hypot(line2[:, 0], line2[:, 1]))
    return np.sqrt((to1**2 + to2**2) / 2)


def sampson_distance(F: ArrayLike, x1: ArrayLike, x2: ArrayLike) -> FloatArray:
    """Return the first-order distance of matches to the epipolar constraint (HZ 11.9, thesis 4.2, before squaring)::

        |x2' F x1| / sqrt((F x1)_1^2 + (F x1)_2^2 + (F' x2)_1^2 + (F' x2)_2^2)

    Args:
        F: (3, 3), any scale.
        x1: (N, 2) pixels.
        x2: (N, 2) pixels, row by row the partners of x1.

    Returns:
        (N,) distances in pixels, >= 0; inf where both epipolar lines vanish.

    Raises:
        ValueError: the shapes are not as above.
    """
    algebraic, line1, line2 = _constraint(F, x1, x2)
    squared = (line1[:, :2] ** 2).sum(axis=1) + (line2[:, :2] ** 2).sum(axis=1)
    return _ratio(np.abs(algebraic), np.sqrt(squared))


def reprojection_distance(F: ArrayLike, x1: ArrayLike, x2: ArrayLike) -> FloatArray:
    """Return the 4D distance of each match to the nearest exact one: min over X of sqrt(d(x1, P1 X)^2 + d(x2, P2 X)^2).

    With the `canonical_cameras` P1, P2 of F this is the term of thesis 4.3 before squaring; every other pair of cameras
    with this F gives the same value (HZ 12.5). The minimum is global, see `nearest_exact_matches`.

    Args:
        F: (3, 3), any scale.
        x1: (N, 2) pixels.
        x2: (N, 2) pixels, row by row the partners of x1.

    Returns:
        (N,) distances in pixels, >= 0; inf where no match fits F.

    Raises:
        ValueError: the shapes are not as above.
    """
    return np.asarray(np.linalg.norm(_shortest_moves(F, x1, x2), axis=1))


def nearest_exact_matches(F: ArrayLike, x1: ArrayLike, x2: ArrayLike) -> tuple[FloatArray, FloatArray]:
    """Return the matches nearest to the given ones that satisfy x2' F x1 = 0.

    This is optimal triangulation in the images (HZ 12.5).

    Args:
        F: (3, 3), any scale.
        x1: (N, 2) pixels.
        x2: (N, 2) pixels, row by row the partners of x1.

    Returns:
        (N, 2), (N, 2) pixels; where several are equally near (both points on the epipoles of a bad match), one of them.

    Raises:
        ValueError: the shapes are not as above.
    """
    moves = _shortest_moves(F, x1, x2)
    return np.asarray(x1, dtype=np.float64) + moves[:, :2], np.asarray(x2, dtype=np.float64) + moves[:, 2:]


def _shortest_moves(F: ArrayLike, x1: ArrayLike, x2: ArrayLike) -> FloatArray:
    """Return (N, 4) shortest z = (dx1, dx2) with q(z) = c + g'z + z'Az/2 = 0, the epipolar constraint after the move.

    A quadratic form under one quadratic constraint has no duality gap (More 1993): the global minimum is
    z = -k (I + k A)^-1 g with the k that solves phi(k) = q(z(k)) = 0 where I + k A is still positive definite. There
    phi falls monotonically, so that Newton's method inside a bracket finds k; its first step gives Sampson's distance.
    A has the eigenvalues +-a, +-b, where a >= b are the singular values of the upper left 2 x 2 of F. This replaces the
    polynomial of degree 6 of Hartley and Sturm.
    """
    c, line1, line2 = _constraint(F, x1, x2)
    U, s, Vt = np.linalg.svd(np.asarray(F, dtype=np.float64)[:2, :2])
    axes = np.vstack([np.hstack([Vt, U.T]), np.hstack([Vt, -U.T])]) / np.sqrt(2)
    sign = np.where(c < 0, -1.0, 1.0)  # q and -q vanish together: c >= 0, hence k >= 0
    c, g = sign * c, sign[:, None] * np.hstack([line1[:, :2], line2[:, :2]]) @ axes.T
    d = sign[:, None] * np.concatenate([s, -s])
    k = _multiplier(c, g, d, float(s[0]))[:, None]
    stretch = 1.0 + k * d
    z = -k * g / stretch
    # a step along the weakest axis removes what rounding, or a bad match on both epipoles, leaves of q
    rest, weakest = _phi(c, g, d, k), np.argmin(d, axis=1)[:, None]
    slope = np.take_along_axis(g / stretch, weakest, axis=1)[:, 0]
    root = np.sqrt(np.maximum(slope**2 + 2.0 * s[0] * rest, 0.0))
    below = slope + np.copysign(root, slope)
    extra = np.divide(-2.0 * rest, below, out=np.zeros_like(rest), where=below != 0)
    np.put_along_axis(z, weakest, np.take_along_axis(z, weakest, axis=1) + extra[:, None], axis=1)
    z = z @ axes
    z[(s[0] == 0) & ~g.any(axis=1)] = np.inf  # q is constant
    return np.asarray(z)


def _multiplier(c: FloatArray, g: FloatArray, d: FloatArray, a: float) -> FloatArray:
    """Find the root (N,) of phi between 0 and 1/a."""
    low, high = np.zeros(len(c)), np.full(len(c), (1.0 - 4.0 * _EPS) / max(a, _TINY))
    k = low.copy()
    for _ in range(_MOST_STEPS):
        phi = _phi(c, g, d, k[:, None])
        low, high = np.where(phi > 0, k, low), np.where(phi > 0, high, k)
        falls = (g**2 / (1.0 + k[:, None] * d) ** 3).sum(axis=1)
        after = k + np.divide(phi, falls, out=np.full(len(c), np.inf), where=falls > 0)
        after = np.where((after >= low) & (after <= high), after, (low + high) / 2)
        done = np.abs(after - k) <= 4.0 * _EPS * after
        k = after
        if done.all():
            break
    return k


def _phi(c: FloatArray, g: FloatArray, d: FloatArray, k: FloatArray) -> FloatArray:
    stretch = 1.0 + k * d
    return np.asarray(c - (g**2 * k * (1.0 + stretch) / (2.0 * stretch**2)).sum(axis=1))


def _constraint(F: ArrayLike, x1: ArrayLike, x2: ArrayLike) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the algebraic error x2' F x1 and the epipolar lines in view 1 and view 2."""
    matrix = np.asarray(F, dtype=np.float64)
    if matrix.shape != (3, 3):
        raise ValueError(f"F must have shape (3, 3), got {matrix.shape}")
    h1, h2 = homogeneous_pair(x1, x2)
    line1, line2 = h2 @ matrix, h1 @ matrix.T
    return (h2 * line2).sum(axis=1), line1, line2


def _ratio(above: FloatArray, below: FloatArray) -> FloatArray:
    return np.asarray(np.divide(above, below, out=np.full(len(above), np.inf), where=below > 0))


# Triangulation of points from two views.


def triangulate(P1: FloatArray, P2: FloatArray, x1: FloatArray, x2: FloatArray) -> FloatArray:
    """Compute points by linear triangulation (thesis Eq. 2.33): the null vector of x x PX = 0 in both views.

    Args:
        P1: (3, 4) projection matrix of view 1.
        P2: (3, 4) projection matrix of view 2.
        x1: (N, 2) points in the image coordinates that P1 projects to.
        x2: (N, 2) partners in view 2.

    Returns:
        (N, 3) points; inf where the rays meet at infinity.
    """
    rows = [x1[:, :1] * P1[2] - P1[0], x1[:, 1:] * P1[2] - P1[1], x2[:, :1] * P2[2] - P2[0], x2[:, 1:] * P2[2] - P2[1]]
    A = np.stack(rows, axis=1)
    A /= np.linalg.norm(A, axis=2, keepdims=True)  # all equations get the same weight
    X = np.linalg.svd(A)[2][:, 3]
    with np.errstate(divide="ignore", invalid="ignore"):
        points: FloatArray = X[:, :3] / X[:, 3:]
    points[~np.isfinite(points).all(axis=1)] = np.inf
    return points


def triangulation_angle_deg(X: FloatArray, center1: FloatArray, center2: FloatArray) -> FloatArray:
    """Return the angle between the two rays to each point.

    Args:
        X: (N, 3) points.
        center1: (3,) camera center of view 1, in the frame of the points.
        center2: (3,) camera center of view 2.

    Returns:
        (N,) degrees in [0, 180].
    """
    ray1, ray2 = X - center1, X - center2
    with np.errstate(invalid="ignore"):
        cosine = (ray1 * ray2).sum(axis=1) / (np.linalg.norm(ray1, axis=1) * np.linalg.norm(ray2, axis=1))
    angles: FloatArray = np.degrees(np.arccos(np.clip(np.nan_to_num(cosine, nan=1.0), -1.0, 1.0)))
    return angles


# Essential matrices and the relative poses that they encode.


def essential_from_fundamental(F: FloatArray, K1: FloatArray, K2: FloatArray) -> FloatArray:
    """Return the essential matrix nearest to K2' F K1 (thesis Eq. 5.7; Eq. 2.30 inverts K by misprint).

    Args:
        F: (3, 3), any scale, x2' F x1 = 0 in pixels.
        K1: (3, 3) camera matrix of view 1.
        K2: (3, 3) camera matrix of view 2.

    Returns:
        (3, 3) with singular values (1, 1, 0).
    """
    return nearest_essential(K2.T @ F @ K1)


def nearest_essential(E: FloatArray) -> FloatArray:
    """Return the essential matrix nearest to E (3, 3), with singular values (1, 1, 0).

    Noise makes the singular values of E unequal; in the nearest essential matrix in the Frobenius norm their mean
    replaces both, and the third is 0 (Hartley & Zisserman, 2nd ed., section 11.7.3). Its scale is then set to 1.
    """
    U, _, Vt = np.linalg.svd(E)
    nearest: FloatArray = U @ np.diag([1.0, 1.0, 0.0]) @ Vt
    return nearest


def decompose_essential(E: FloatArray) -> list[tuple[FloatArray, FloatArray]]:
    """Return the four poses (R, t) of view 2 from view 1 that E allows (thesis Eq. 2.32 with corrected signs).

    The thesis's U W V' is a rotation only if det(U) det(V) = 1, which an SVD does not guarantee, so both are
    made rotations first. t has length 1; the scale is not observable.
    """
    U, _, Vt = np.linalg.svd(E)
    U = U * np.sign(np.linalg.det(U))
    Vt = Vt * np.sign(np.linalg.det(Vt))
    W = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    t = U[:, 2]
    return [(R, sign * t) for R in (U @ W @ Vt, U @ W.T @ Vt) for sign in (1.0, -1.0)]


def relative_pose(
    E: FloatArray, x1: FloatArray, x2: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray, NDArray[np.bool_]]:
    """Choose the one of the four poses of E with most points in front of both cameras.

    Args:
        E: (3, 3) essential matrix.
        x1: (N, 2) normalized image points of view 1, that is (K1^-1 x)_1,2.
        x2: (N, 2) partners in view 2.

    Returns:
        R (3, 3) and t (3,) of view 2 from view 1; X (N, 3) points in the frame of view 1; in_front (N,) whether a point
        lies in front of both cameras.
    """
    found = []
    for R, t in decompose_essential(E):
        X = triangulate(np.eye(3, 4), np.column_stack([R, t]), x1, x2)
        known = np.isfinite(X[:, 2])
        with np.errstate(invalid="ignore"):  # some BLAS warn of points at infinity, others do not
            in_front = known & (X[:, 2] > 0) & ((X @ R.T + t)[:, 2] > 0)
        found.append((int(np.count_nonzero(in_front)), R, t, X, in_front))
    _, R, t, X, in_front = max(found, key=lambda pose: pose[0])
    return R, t, X, in_front


# The epipolar geometry of two photos through known lenses, by rays: q' F p = 0, also where rays look backwards.
#
# The eight-point method (thesis 4.3.2) on rays, and Sampson's distance (thesis 4.2) in the photos, where the noise
# is. Matches are rows of 18 numbers: the bearing vectors of `bearings` in view 1 and in view 2.

FIRST, SECOND = slice(0, 3), slice(9, 12)
"""Columns of the rays of view 1 and of view 2. By definition."""
_SLOPES_1, _SLOPES_2 = (slice(3, 6), slice(6, 9)), (slice(12, 15), slice(15, 18))
"""Columns of their derivatives. By definition."""
ROTATION_ROUNDS = 10
"""Rounds of reweighted fits of a rotation. Chosen by hand; not measured on its own."""
LEAST = 1e-30
"""Added to squared derivatives. Its square root is far above rounding in double precision."""


def squared_distances(Fs: FloatArray, lines: FloatArray) -> FloatArray:
    """Return (S, N) squared Sampson distances in the photos, in their unit.

    Args:
        Fs: (S, 3, 3) of rays.
        lines: (N, 18) matches.
    """
    p, q = lines[:, FIRST], lines[:, SECOND]
    terms = [(q, p), *((lines[:, side], p) for side in _SLOPES_2), *((q, lines[:, side]) for side in _SLOPES_1)]
    design = np.concatenate([(b[:, :, None] * a[:, None, :]).reshape(-1, 9) for b, a in terms])
    algebraic, *slopes = (design @ Fs.reshape(-1, 9).T).reshape(5, len(lines), len(Fs))
    return np.asarray((algebraic**2 / (sum(slope**2 for slope in slopes) + LEAST)).T, np.float64)


def signed_distances(E: FloatArray, lines: FloatArray) -> FloatArray:
    """Return (N,) signed Sampson distances of one matrix, in the unit of the photos.

    Args:
        E: (3, 3) essential or fundamental matrix of rays.
        lines: (N, 18) matches.
    """
    p, q = lines[:, FIRST], lines[:, SECOND]
    return np.asarray(np.einsum("ni,ni->n", q, p @ E.T) / gradients(E, lines), np.float64)


def gradients(E: FloatArray, lines: FloatArray) -> FloatArray:
    """Return (N,) lengths of the gradients of q' E p by the four pixel coordinates, > 0.

    Args:
        E: (3, 3) of rays.
        lines: (N, 18) matches.
    """
    line2, line1 = lines[:, FIRST] @ E.T, lines[:, SECOND] @ E
    slopes = sum(
        np.einsum("ni,ni->n", lines[:, columns], across) ** 2
        for across, both in ((line2, _SLOPES_2), (line1, _SLOPES_1))
        for columns in both
    )
    return np.asarray(np.sqrt(slopes + LEAST), np.float64)


def fit_rays(p: FloatArray, q: FloatArray, weights: FloatArray | None = None) -> FloatArray:
    """Return (..., 3, 3) of rank two with the least weighted sum of (q' F p)^2.

    Args:
        p, q: (..., N, 3) rays of view 1; partners in view 2.
        weights: (..., N); all alike if None.
    """
    rows = (q[..., :, None] * p[..., None, :]).reshape(*p.shape[:-1], 9)
    weighted = rows if weights is None else rows * weights[..., None]
    _, vectors = np.linalg.eigh(np.swapaxes(weighted, -1, -2) @ rows)
    U, s, Vt = np.linalg.svd(vectors[..., :, 0].reshape(*rows.shape[:-2], 3, 3))
    s[..., 2] = 0.0
    return np.asarray((U * s[..., None, :]) @ Vt, np.float64)


def depths(used: FloatArray, R: FloatArray, t: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the depths (N,) in view 1 and (N,) in view 2 at which the two rays of each match are closest.

    Depths are multiples of the rays.

    Args:
        used: (N, 18) matches.
        R: (3, 3) rotation of view 2 from view 1.
        t: (3,) translation.
    """
    h1, h2 = used[:, FIRST] @ R.T, used[:, SECOND]
    # least squares of d1 h1 + t = d2 h2
    a, b, c = (h1 * h1).sum(1), (h1 * h2).sum(1), (h2 * h2).sum(1)
    p, q = h1 @ t, h2 @ t
    determinant = np.maximum(a * c - b * b, 1e-300)
    return (b * q - c * p) / determinant, (a * q - b * p) / determinant


def rotation_residuals(used: FloatArray, R: FloatArray) -> FloatArray:
    """Return residuals (N,), in pixels of view 2, of the rotation near R that explains most matches.

    Rays are rotated onto their partners (Kabsch), with robust weights.

    Args:
        used: (N, 18) matches as bearing vectors, view 1 and view 2.
        R: (3, 3) rotation of view 2 from view 1, to start from.
    """
    h1, h2 = (_normalize(used[:, view]) for view in (FIRST, SECOND))
    focal = pixels_per_radian(used.reshape(-1, 9))
    for _ in range(ROTATION_ROUNDS):
        distances = focal * np.linalg.norm(h1 @ R.T - h2, axis=1)
        weights = 1.0 / (1.0 + distances**2)
        U, _, Vt = np.linalg.svd(np.einsum("ni,nj->ij", h2 * weights[:, None], h1))
        R = U @ np.diag([1.0, 1.0, np.sign(np.linalg.det(U @ Vt))]) @ Vt
    return np.asarray(focal * np.linalg.norm(h1 @ R.T - h2, axis=1), np.float64)


def _normalize(h: FloatArray) -> FloatArray:
    return np.asarray(h / np.linalg.norm(h, axis=1, keepdims=True), np.float64)


# Two-view reconstructions that a mapping can start from.

GOOD_ANGLE_DEG = 12.0
"""Wider angles than this make no better seed: depth is well determined already, and matches get rarer.
docs/algorithms.md, Mapping. Chosen by hand; halved and doubled by `benchmarks.sensitivity`."""


@dataclass(frozen=True, slots=True, eq=False)
class TwoViewSeed:
    """Pose of view 2 from view 1, and the points both see, in the frame of view 1 (baseline 1)."""

    R: FloatArray
    t: FloatArray
    points: FloatArray
    """(N, 3), one per inlier, in the order given."""
    usable: NDArray[np.bool_]
    """(N,) whether a point is in front of both cameras and its triangulation angle determines its depth."""
    angle_deg: float
    """Median triangulation angle of the points in front of both cameras."""
    in_front: float
    """Share of the inliers that lie in front of both cameras, 0 to 1."""


def two_view_seed(E: FloatArray, x1: FloatArray, x2: FloatArray) -> TwoViewSeed:
    """Decompose E and triangulate all its inliers.

    Args:
        E: (3, 3) with x2' E x1 = 0; the nearest essential matrix is used.
        x1: (N, 2) inliers as points of the plane z = 1, see `geometry.camera.rays`.
        x2: (N, 2) partners.
    """
    return _judge_seed(*relative_pose(nearest_essential(E), x1, x2))


def ray_seed(R: FloatArray, t: FloatArray, lines: FloatArray) -> TwoViewSeed:
    """Return the seed of a pose, with each inlier at the point midway between its rays.

    Args:
        R: (3, 3) rotation of view 2 from view 1.
        t: (3,) unit vector along its translation.
        lines: (N, 18) inliers as bearing vectors, see `geometry.lenses.bearings`, view 1 and view 2.
    """
    first, second = depths(lines, R, t)
    X = 0.5 * (first[:, None] * lines[:, FIRST] + (second[:, None] * lines[:, SECOND] - t) @ R)
    return _judge_seed(R, t, X, (first > 0) & (second > 0))


def _judge_seed(R: FloatArray, t: FloatArray, X: FloatArray, in_front: NDArray[np.bool_]) -> TwoViewSeed:
    angles = triangulation_angle_deg(X, np.zeros(3), -R.T @ t)
    angle = float(np.median(angles[in_front])) if in_front.any() else 0.0
    usable = in_front & (angles > min(1.0, angle / 4))
    return TwoViewSeed(R, t, X, usable, angle, float(in_front.mean()) if len(X) else 0.0)
