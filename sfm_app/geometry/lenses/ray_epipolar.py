"""The epipolar geometry of two photos through known lenses, by rays: q' F p = 0, also where rays look backwards.

The eight-point method (thesis 4.3.2) on rays, and Sampson's distance (thesis 4.2) in the photos, where the noise is.
Matches are rows of 18 numbers: the bearing vectors of `bearings` in view 1 and in view 2.
"""

import numpy as np
from numpy.typing import NDArray

from sfm_app.geometry.lenses.bearings import pixels_per_radian

FloatArray = NDArray[np.float64]

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
