"""How far a match is from an epipolar geometry: the four error measures of thesis section 4.2.

Linear fits minimize `algebraic_distance`; `symmetric_epipolar_distance` is measured from points to lines;
`sampson_distance` is the first-order approximation of `reprojection_distance`, the distance itself: the length of the
shortest move of both points, in 4D, that makes the match exact. Points are (N, 2) pixels, ``x2' F x1 = 0``.
"""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sfm_app.geometry.epipolar import homogeneous_pair

FloatArray = NDArray[np.float64]

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
