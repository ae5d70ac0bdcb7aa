"""The epipolar geometry of two photos through a known lens, by rays: q' F p = 0, also where rays look backwards.

Ours, of known parts: the eight-point method (thesis 2.4.2) on rays of length 1, samples scored by a truncated loss
(MSAC, Torr and Zisserman 2000), and Sampson's distance (thesis 4.2) in the photo, where the noise is.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sfm_app.selfcal.wide_angle.fisheye import Fisheye, rays_and_slopes

FloatArray = NDArray[np.float64]
IndexArray = NDArray[np.int64]

REFITS = 3
"""Refits to the inliers of the best sample. Chosen by hand; not measured on its own."""
MIN_INLIERS = 12
"""Fewer inliers are not refitted: eight determine F. Chosen by hand; not measured on its own."""
LEAST = 1e-30
"""Added to squared derivatives. Its square root is far above rounding in double precision."""

Rays = tuple[FloatArray, FloatArray, FloatArray]
"""Rays (N, 3) and their derivatives by x and y of the photo."""


class RayPair(NamedTuple):
    """Matches of two photos through one lens, as rays."""

    first: Rays
    second: Rays


def make_ray_pair(lens: Fisheye, matches: FloatArray) -> RayPair:
    """Return matches (N, 4) as rays.

    Args:
        lens: of both photos, in the unit of the matches.
        matches: x1, y1, x2, y2.
    """
    return RayPair(rays_and_slopes(lens, matches[:, :2]), rays_and_slopes(lens, matches[:, 2:]))


def squared_distances(Fs: FloatArray, pair: RayPair) -> FloatArray:
    """Return (S, N) squared Sampson distances in the photos, in their unit.

    Args:
        Fs: (S, 3, 3).
        pair: N matches.
    """
    (p, p_x, p_y), (q, q_x, q_y) = pair
    lines2, lines1 = np.einsum("sij,nj->sni", Fs, p), np.einsum("sji,nj->sni", Fs, q)
    algebraic = np.einsum("ni,sni->sn", q, lines2)
    slopes = sum(
        np.einsum("ni,sni->sn", slope, lines) ** 2
        for slope, lines in ((q_x, lines2), (q_y, lines2), (p_x, lines1), (p_y, lines1))
    )
    return np.asarray(algebraic**2 / (slopes + LEAST), np.float64)


def signed_distances(E: FloatArray, pair: RayPair) -> FloatArray:
    """Return (N,) signed Sampson distances of one matrix, in the unit of the photos.

    Args:
        E: (3, 3) essential or fundamental matrix of rays.
        pair: N matches.
    """
    (p, p_x, p_y), (q, q_x, q_y) = pair
    line2, line1 = p @ E.T, q @ E
    slopes = sum(
        np.einsum("ni,ni->n", slope, line) ** 2
        for slope, line in ((q_x, line2), (q_y, line2), (p_x, line1), (p_y, line1))
    )
    return np.asarray(np.einsum("ni,ni->n", q, line2) / np.sqrt(slopes + LEAST), np.float64)


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


def search_rays(pair: RayPair, samples: IndexArray, threshold: float) -> tuple[float, FloatArray]:
    """Return the support of the best F, in matches, and F (3, 3).

    A match counts 1 - d^2 / threshold^2, or nothing beyond the threshold.

    Args:
        pair: N matches.
        samples: (S, 8) rows of them.
        threshold: largest distance of an inlier, in the unit of the photo, > 0.
    """
    p, q = pair.first[0], pair.second[0]
    Fs = fit_rays(p[samples], q[samples])
    supports = _supports(Fs, pair, threshold)
    best = int(np.argmax(supports))
    F, support = Fs[best], float(supports[best])
    for _ in range(REFITS):
        inliers = squared_distances(F[None], pair)[0] < threshold**2
        if np.count_nonzero(inliers) < MIN_INLIERS:
            break
        again = fit_rays(p[inliers], q[inliers])
        value = float(_supports(again[None], pair, threshold)[0])
        if value <= support:
            break
        F, support = again, value
    return support, F


def _supports(Fs: FloatArray, pair: RayPair, threshold: float) -> FloatArray:
    return np.asarray(np.sum(1.0 - np.minimum(squared_distances(Fs, pair) / threshold**2, 1.0), axis=1), np.float64)
