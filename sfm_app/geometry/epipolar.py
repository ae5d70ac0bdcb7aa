"""Epipolar geometry of two views: F, E, distances, poses and triangulation, for pixels and for rays.

x2' F x1 = 0 throughout. Unless stated otherwise, x1 and x2 are (N, 2) pixels, row by row partners, and F is (3, 3) of
any scale; other shapes raise ValueError. HZ: Hartley and Zisserman, Multiple View Geometry, 2nd edition.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from sfm_app.errors import NumericalError
from sfm_app.types.arrays import BoolArray, FloatArray


def to_homogeneous(x: ArrayLike) -> FloatArray:
    """Return (N, 2) points as (N, 3) with a last coordinate of 1; ValueError for any other shape."""
    points = np.asarray(x, dtype=np.float64)
    if points.ndim != 2 or points.shape[1] != 2:
        raise ValueError(f"points must have shape (N, 2), got {points.shape}")
    return np.column_stack([points, np.ones(len(points))])


def homogeneous_pair(x1: ArrayLike, x2: ArrayLike) -> tuple[FloatArray, FloatArray]:
    """Return both views of N matches as (N, 3)."""
    h1, h2 = to_homogeneous(x1), to_homogeneous(x2)
    if len(h1) != len(h2):
        raise ValueError(f"x1 and x2 must pair up, got {len(h1)} and {len(h2)} points")
    return h1, h2


def hartley_normalization(x: ArrayLike) -> FloatArray:
    """Return the (3, 3) similarity to centroid 0 and mean distance sqrt(2); NumericalError if all points coincide."""
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

    `weights` (N,) >= 0 multiply the squared algebraic errors. F has rank 2 and Frobenius norm 1; if the matches do not
    determine it (all on one plane), it is one of the solutions.

    Raises:
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
    # all of V, but not all of U, which is as large as the number of matches squared
    F = np.linalg.svd(design, full_matrices=len(design) < 9)[2][8].reshape(3, 3)
    return to_unit_norm(T2.T @ nearest_rank_two(F) @ T1)


def nearest_rank_two(F: ArrayLike) -> FloatArray:
    """Return the matrices of rank 2 that are nearest to F (..., 3, 3) in the Frobenius norm (thesis 4.2)."""
    U, s, Vt = np.linalg.svd(np.asarray(F, dtype=np.float64))
    rank_two: FloatArray = (U[..., :2] * s[..., None, :2]) @ Vt[..., :2, :]
    return rank_two


def to_unit_norm(F: ArrayLike) -> FloatArray:
    """Return F with norm 1 and its largest entry positive; NumericalError if it is zero or not finite."""
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
    conditioned as F permits. In pixels s1 / s2 is large: pass the F of centered points with coordinates near 1.

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
    """Return F, norm 1, of x1 ~ K1 X and x2 ~ K2 (R X + t) (HZ 9.12); NumericalError without a baseline."""
    K1, K2, R = (np.asarray(m, dtype=np.float64) for m in (K1, K2, R))
    return to_unit_norm(np.linalg.inv(K2).T @ cross_matrix(t) @ R @ np.linalg.inv(K1))


# The four error measures of thesis section 4.2. Linear fits minimize `algebraic_distance`;
# `symmetric_epipolar_distance` is measured from points to lines; `sampson_distance` is the first-order approximation
# of `reprojection_distance`, the length of the shortest move of both points, in 4D, that makes the match exact.

_EPS = float(np.finfo(float).eps)
"""Spacing of numbers at 1 in double precision."""
_TINY = float(np.finfo(float).tiny)
"""The smallest normal number in double precision."""


def algebraic_distance(F: ArrayLike, x1: ArrayLike, x2: ArrayLike) -> FloatArray:
    """Return (N,) |x2' F x1| with F of Frobenius norm 1 and points (x, y, 1): |A b| per match (thesis 2.28 and 4.2).

    It has no unit and depends on the origin and scale of the coordinates: pass points and F in the intended frame, such
    as that of `hartley_normalization`. It is inf where F is zero.
    """
    algebraic, _, _ = _constraint(F, x1, x2)
    return _ratio(np.abs(algebraic), np.full(len(algebraic), np.linalg.norm(np.asarray(F, dtype=np.float64))))


def symmetric_epipolar_distance(F: ArrayLike, x1: ArrayLike, x2: ArrayLike) -> FloatArray:
    """Return (N,) RMS px of the distances to both epipolar lines (HZ 11.10, thesis 4.1); inf where a line vanishes."""
    algebraic, line1, line2 = _constraint(F, x1, x2)
    to1 = _ratio(np.abs(algebraic), np.hypot(line1[:, 0], line1[:, 1]))
    to2 = _ratio(np.abs(algebraic), np.hypot(line2[:, 0], line2[:, 1]))
    return np.sqrt((to1**2 + to2**2) / 2)


def sampson_distance(F: ArrayLike, x1: ArrayLike, x2: ArrayLike) -> FloatArray:
    """Return the first-order distance of matches to the epipolar constraint (HZ 11.9, thesis 4.2, before squaring)::

        |x2' F x1| / sqrt((F x1)_1^2 + (F x1)_2^2 + (F' x2)_1^2 + (F' x2)_2^2)

    (N,) pixels; inf where both epipolar lines vanish.
    """
    algebraic, line1, line2 = _constraint(F, x1, x2)
    squared = (line1[:, :2] ** 2).sum(axis=1) + (line2[:, :2] ** 2).sum(axis=1)
    return _ratio(np.abs(algebraic), np.sqrt(squared))


def reprojection_distance(F: ArrayLike, x1: ArrayLike, x2: ArrayLike) -> FloatArray:
    """Return the 4D distance of each match to the nearest exact one: min over X of sqrt(d(x1, P1 X)^2 + d(x2, P2 X)^2).

    With the `canonical_cameras` P1, P2 of F this is the term of thesis 4.3 before squaring; every other pair of cameras
    with this F gives the same value (HZ 12.5). The minimum is global, see `nearest_exact_matches`. (N,) pixels; inf
    where no match fits F.
    """
    return np.asarray(np.linalg.norm(_shortest_moves(F, x1, x2), axis=1))


def nearest_exact_matches(F: ArrayLike, x1: ArrayLike, x2: ArrayLike) -> tuple[FloatArray, FloatArray]:
    """Return the nearest matches with x2' F x1 = 0: optimal triangulation in the images (HZ 12.5); one of equals."""
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
    for _ in range(100):  # bisection alone takes 60, Newton's method 3 to 6
        phi = _phi(c, g, d, k[:, None])
        low, high = np.where(phi > 0, k, low), np.where(phi > 0, high, k)
        slope = (g**2 / (1.0 + k[:, None] * d) ** 3).sum(axis=1)
        after = k + np.divide(phi, slope, out=np.full(len(c), np.inf), where=slope > 0)
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


def triangulate(P1: FloatArray, P2: FloatArray, x1: FloatArray, x2: FloatArray) -> FloatArray:
    """Compute points (N, 3) by linear triangulation (thesis Eq. 2.33): the null vector of x x PX = 0 in both views.

    x1, x2 are in the image coordinates that P1, P2 (3, 4) project to. Points are inf where the rays meet at infinity.
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
    """Return the angle (N,) between the two rays to each point (N, 3), in degrees in [0, 180]; 0 at infinity."""
    ray1, ray2 = X - center1, X - center2
    with np.errstate(invalid="ignore", over="ignore"):
        sine, cosine = np.linalg.norm(np.cross(ray1, ray2), axis=1), np.sum(ray1 * ray2, axis=1)
    # atan2 keeps small angles exact, where arccos of a rounded cosine does not
    return np.where(np.isfinite(sine), np.degrees(np.arctan2(sine, cosine)), 0.0)


def essential_from_fundamental(F: FloatArray, K1: FloatArray, K2: FloatArray) -> FloatArray:
    """Return the essential matrix nearest to K2' F K1 (thesis Eq. 5.7; Eq. 2.30 inverts K by misprint)."""
    return nearest_essential(K2.T @ F @ K1)


def nearest_essential(E: FloatArray) -> FloatArray:
    """Return the essential matrix nearest to E (HZ 11.7.3), scaled to the singular values (1, 1, 0)."""
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


def relative_pose(E: FloatArray, x1: FloatArray, x2: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return R (3, 3) and t (3,) of view 2 from view 1: of the four poses of E, the one with most points in front.

    x1, x2 (N, 2) are normalized image points (K^-1 x)_1,2.
    """
    rays1, rays2 = (np.column_stack([x, np.ones(len(x))]) for x in (x1, x2))

    def points_in_front(pose: tuple[FloatArray, FloatArray]) -> int:
        first, second = _ray_depths(rays1, rays2, *pose)
        return int(np.count_nonzero((first > 0) & (second > 0)))

    return max(decompose_essential(E), key=points_in_front)


# Epipolar geometry through known lenses, by rays: q' F p = 0, also where rays look backwards. The eight-point method
# (thesis 4.3.2) on rays, and Sampson's distance (thesis 4.2) in the photos, where the noise is. Matches are rows of
# 18 numbers: the bearing vectors of `camera.bearings` in view 1 and in view 2.

FIRST, SECOND = slice(0, 3), slice(9, 12)
"""Columns of the rays of view 1 and of view 2. By definition."""
_SLOPES_1, _SLOPES_2 = (slice(3, 6), slice(6, 9)), (slice(12, 15), slice(15, 18))
"""Columns of their derivatives. By definition."""
_LEAST = 1e-30
"""Added to squared derivatives; its square root is far above rounding in double precision."""


def squared_distances(Fs: FloatArray, lines: FloatArray) -> FloatArray:
    """Return (S, N) squared Sampson distances in the photos, in their unit, for matrices of rays (S, 3, 3)."""
    p, q = lines[:, FIRST], lines[:, SECOND]
    terms = [(q, p), *((lines[:, side], p) for side in _SLOPES_2), *((q, lines[:, side]) for side in _SLOPES_1)]
    design = np.concatenate([(b[:, :, None] * a[:, None, :]).reshape(-1, 9) for b, a in terms])
    algebraic, *slopes = (design @ Fs.reshape(-1, 9).T).reshape(5, len(lines), len(Fs))
    return np.asarray((algebraic**2 / (sum(slope**2 for slope in slopes) + _LEAST)).T, np.float64)


def signed_distances(E: FloatArray, lines: FloatArray) -> FloatArray:
    """Return (N,) signed Sampson distances of one matrix of rays, in the unit of the photos."""
    p, q = lines[:, FIRST], lines[:, SECOND]
    return np.asarray(np.einsum("ni,ni->n", q, p @ E.T) / gradients(E, lines), np.float64)


def gradients(E: FloatArray, lines: FloatArray) -> FloatArray:
    """Return (N,) lengths > 0 of the gradients of q' E p by the four pixel coordinates."""
    line2, line1 = lines[:, FIRST] @ E.T, lines[:, SECOND] @ E
    slopes = sum(
        np.einsum("ni,ni->n", lines[:, columns], line) ** 2
        for line, both in ((line2, _SLOPES_2), (line1, _SLOPES_1))
        for columns in both
    )
    return np.asarray(np.sqrt(slopes + _LEAST), np.float64)


def fit_rays(p: FloatArray, q: FloatArray, weights: FloatArray | None = None) -> FloatArray:
    """Return (..., 3, 3) of rank two with the least weighted sum of (q' F p)^2, from rays p and q (..., N, 3)."""
    rows = (q[..., :, None] * p[..., None, :]).reshape(*p.shape[:-1], 9)
    weighted = rows if weights is None else rows * weights[..., None]
    _, vectors = np.linalg.eigh(np.swapaxes(weighted, -1, -2) @ rows)
    return nearest_rank_two(vectors[..., :, 0].reshape(*rows.shape[:-2], 3, 3))


def depths(lines: FloatArray, R: FloatArray, t: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the depths (N,) in either view, as multiples of the rays, at which the rays of matches are closest."""
    return _ray_depths(lines[:, FIRST], lines[:, SECOND], R, t)


def _ray_depths(rays1: FloatArray, rays2: FloatArray, R: FloatArray, t: FloatArray) -> tuple[FloatArray, FloatArray]:
    h1, h2 = rays1 @ R.T, rays2
    # least squares of d1 h1 + t = d2 h2
    a, b, c = (h1 * h1).sum(1), (h1 * h2).sum(1), (h2 * h2).sum(1)
    p, q = h1 @ t, h2 @ t
    determinant = np.maximum(a * c - b * b, 1e-300)
    return (b * q - c * p) / determinant, (a * q - b * p) / determinant


def pixels_per_radian(lines: FloatArray) -> float:
    """Return the scale at the center of the photo, the focal of a perspective camera, from bearings (N, 9), N > 0."""
    lengths = np.linalg.norm(lines[:, 3:9].reshape(-1, 3), axis=1)
    return float(np.mean(1.0 / lengths))


def rotation_residuals(lines: FloatArray, R: FloatArray) -> FloatArray:
    """Return residuals (N,), in px of view 2, of the rotation near R that explains most matches (robust Kabsch)."""
    h1, h2 = (h / np.linalg.norm(h, axis=1, keepdims=True) for h in (lines[:, FIRST], lines[:, SECOND]))
    focal = pixels_per_radian(lines.reshape(-1, 9))
    for _ in range(10):
        distances = focal * np.linalg.norm(h1 @ R.T - h2, axis=1)
        weights = 1.0 / (1.0 + distances**2)
        U, _, Vt = np.linalg.svd(np.einsum("ni,nj->ij", h2 * weights[:, None], h1))
        R = U @ np.diag([1.0, 1.0, np.sign(np.linalg.det(U @ Vt))]) @ Vt
    return np.asarray(focal * np.linalg.norm(h1 @ R.T - h2, axis=1), np.float64)


GOOD_ANGLE_DEG = 12.0
"""Triangulation angle in degrees beyond which seeds do not get better: depth is well determined, and matches get rarer.
docs/algorithms/mapping.md. Chosen by hand."""


@dataclass(frozen=True, slots=True, eq=False)
class TwoViewSeed:
    """Pose of view 2 from view 1, and the points both see, in the frame of view 1 (baseline 1)."""

    R: FloatArray
    t: FloatArray
    points: FloatArray
    """(N, 3), one per inlier, in the order given."""
    usable: BoolArray
    """(N,) whether a point is in front of both cameras and its triangulation angle determines its depth."""
    angle_deg: float
    """Median triangulation angle of the points in front of both cameras."""
    in_front: float
    """Share of the inliers that lie in front of both cameras, 0 to 1."""


def two_view_seed(E: FloatArray, x1: FloatArray, x2: FloatArray) -> TwoViewSeed:
    """Decompose E and triangulate all its inliers (N, 2), points of the plane z = 1."""
    R, t = relative_pose(nearest_essential(E), x1, x2)
    X = triangulate(np.eye(3, 4), np.column_stack([R, t]), x1, x2)
    with np.errstate(invalid="ignore"):  # some BLAS warn of points at infinity, others do not
        in_front = np.isfinite(X[:, 2]) & (X[:, 2] > 0) & ((X @ R.T + t)[:, 2] > 0)
    return _judge_seed(R, t, X, in_front)


def ray_seed(R: FloatArray, t: FloatArray, lines: FloatArray) -> TwoViewSeed:
    """Return the seed of a pose R, t (unit vector), with each inlier at the point midway between its rays."""
    first, second = depths(lines, R, t)
    X = 0.5 * (first[:, None] * lines[:, FIRST] + (second[:, None] * lines[:, SECOND] - t) @ R)
    return _judge_seed(R, t, X, (first > 0) & (second > 0))


def _judge_seed(R: FloatArray, t: FloatArray, X: FloatArray, in_front: BoolArray) -> TwoViewSeed:
    angles = triangulation_angle_deg(X, np.zeros(3), -R.T @ t)
    angle = float(np.median(angles[in_front])) if in_front.any() else 0.0
    usable = in_front & (angles > min(1.0, angle / 4))
    return TwoViewSeed(R, t, X, usable, angle, float(in_front.mean()) if len(X) else 0.0)
