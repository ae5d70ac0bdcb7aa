"""Similarities between two sets of points in space: scale, rotation, translation."""

from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from sfm_app.errors import NumericalError
from sfm_app.numerical import MAD_TO_SIGMA

FloatArray = NDArray[np.float64]

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
    return bool(s[1] <= 1e-6 * s[0])
