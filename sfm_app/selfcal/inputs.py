"""Fundamental matrices as every calibrator expects them: checked, of rank 2, in image units.

Thesis 5.6.4 brings every F to norm 1; rank 2 and the epipoles are ours.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sfm_app.types import CameraPairs

FloatArray = NDArray[np.float64]

FULL_WEIGHT_INLIERS = 300
"""A pair with this many inliers or more counts fully. Chosen by hand; halved and doubled by
`benchmarks.sensitivity`."""


@dataclass(frozen=True, slots=True, eq=False)
class Pairs:
    """P fundamental matrices in image units, with the parts of them that E = K'FK needs."""

    F: FloatArray
    """(P, 3, 3), rank 2, Frobenius norm 1."""
    e1: FloatArray
    """(P, 3) unit epipoles of view 1: F e1 = 0."""
    e2: FloatArray
    """(P, 3) unit epipoles of view 2: F' e2 = 0."""
    product: FloatArray
    """(P,) products of the two non-zero singular values of F."""
    weights: FloatArray
    """(P,) how far each F is trusted, > 0."""
    kept: NDArray[np.int64]
    """(P,) their indices among the given matrices."""

    def __len__(self) -> int:
        return len(self.F)

    @property
    def packed_rows(self) -> FloatArray:
        """(P, 16) F by rows, e1, e2 and product side by side, for kernels."""
        return np.column_stack([self.F.reshape(-1, 9), self.e1, self.e2, self.product])


def pair_weights(inlier_counts: ArrayLike) -> FloatArray:
    """Return the weights of fundamental matrices from their numbers n of inliers: min(1, n / 300)."""
    counts = np.asarray(inlier_counts, dtype=np.float64)
    return np.minimum(1.0, counts / FULL_WEIGHT_INLIERS)


def prepare(pairs: CameraPairs, *, unit_px: float, origin_px: tuple[float, float]) -> Pairs:
    """Check the input of a calibrator and express it in units of `unit_px` from `origin_px`.

    Pairs of weight 0 are left out, and so is an F that repeats another, in either direction: it is no further evidence.

    Args:
        pairs: P may be 0.
        unit_px: length that becomes 1, in pixels.
        origin_px: pixel that becomes (0, 0).

    Raises:
        ValueError: a shape is wrong, a number is not finite, a weight is negative, an F is zero, or the size or a
            claimed focal is not positive.
    """
    raw, trust, used = check_pairs(pairs)
    to_pixels = np.array([[unit_px, 0.0, origin_px[0]], [0.0, unit_px, origin_px[1]], [0.0, 0.0, 1.0]])
    # scaled first, so that the products of entries such as 1e200 or 1e-200 neither overflow nor underflow
    scaled = raw / np.max(np.abs(raw), axis=(1, 2), keepdims=True)
    distinct = _distinct_indices(scaled)
    scaled, trust = scaled[distinct], trust[distinct]
    U, s, Vt = np.linalg.svd(to_pixels.T @ scaled @ to_pixels)
    s = s[:, :2] / np.linalg.norm(s[:, :2], axis=1, keepdims=True)
    return Pairs(
        F=(U[:, :, :2] * s[:, None, :]) @ Vt[:, :2, :],
        e1=Vt[:, 2, :],
        e2=U[:, :, 2],
        product=s[:, 0] * s[:, 1],
        weights=trust,
        kept=used[distinct],
    )


def check_pairs(pairs: CameraPairs) -> tuple[FloatArray, FloatArray, NDArray[np.int64]]:
    """Return matrices (Q, 3, 3) and weights (Q,) of the pairs with a weight, and their indices.

    Raises:
        ValueError: as `prepare`.
    """
    raw = np.asarray(pairs.Fs, dtype=np.float64)
    trust = np.asarray(pairs.weights, dtype=np.float64)
    size = pairs.size
    if raw.size == 0:
        raw = raw.reshape(0, 3, 3)
    if raw.ndim != 3 or raw.shape[1:] != (3, 3):
        raise ValueError(f"fundamental matrices must have shape (P, 3, 3), not {raw.shape}")
    if trust.shape != (len(raw),):
        raise ValueError(f"weights must have shape ({len(raw)},), one per fundamental matrix, not {trust.shape}")
    if not np.all(np.isfinite(raw)):
        raise ValueError("fundamental matrices must be finite, found NaN or infinity")
    if not np.all(np.isfinite(trust) & (trust >= 0)):
        raise ValueError("weights must be finite and >= 0")
    if np.any(np.all(raw == 0, axis=(1, 2))):
        raise ValueError("a fundamental matrix is zero")
    if len(size) != 2 or not all(np.isfinite(side) and side > 0 for side in size):
        raise ValueError(f"size must be (width, height) in pixels, both > 0, not {size}")
    if pairs.inliers and len(pairs.inliers) != len(raw):
        raise ValueError(f"inliers of {len(pairs.inliers)} pairs were given for {len(raw)} fundamental matrices")
    if any(x.ndim != 2 or x.shape[1] != 4 or not np.all(np.isfinite(x)) for x in map(np.asarray, pairs.inliers)):
        raise ValueError("inliers must have shape (N, 4) per pair and be finite")
    if not all(np.isfinite(focal) and focal > 0 for focal in pairs.focal_hints_px):
        raise ValueError("claimed focals must be finite and > 0")
    if pairs.photos and len(pairs.photos) != len(raw):
        raise ValueError(f"photos of {len(pairs.photos)} pairs were given for {len(raw)} fundamental matrices")
    used = np.flatnonzero(trust > 0)
    return raw[used], trust[used], used


def _distinct_indices(scaled: FloatArray) -> NDArray[np.int64]:
    """Return the indices of the first of all matrices that agree to 9 digits up to sign and transposition."""
    seen: dict[bytes, int] = {}
    for index, F in enumerate(scaled):
        keys = [(np.round(sign * G, 9) + 0.0).tobytes() for sign in (1, -1) for G in (F, F.T)]
        seen.setdefault(min(keys), index)
    return np.array(sorted(seen.values()), dtype=np.int64)
