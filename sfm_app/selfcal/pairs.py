"""Pairs as self-calibration takes them, camera parameters, the lens, and the calibration as a result."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from sfm_app.camera.models import camera_matrix, guessed_camera_matrix
from sfm_app.camera.projection import BEARING, fold_radius, unproject_point
from sfm_app.camera.rows import CX, CY, FX, FY, K1, PERSPECTIVE
from sfm_app.jit import kernel
from sfm_app.types import Calibration, CameraPairs, CameraPrior
from sfm_app.types.arrays import FloatArray, IndexArray
from sfm_app.types.camera import CLAIM

# The input of every calibrator: checked, of rank 2, in image units (thesis 5.6.4; rank 2 and epipoles are ours).

LEAST_PAIRS = 3
"""Pairs that one camera needs: each F gives two constraints, and with two pairs nothing contradicts a wrong K. By
definition of the constraint (thesis 5.2.4)."""
FULL_WEIGHT_INLIERS = 300
"""Inliers from which on a pair counts fully; by hand."""


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
    indices: IndexArray
    """(P,) rows of the given matrices."""

    def __len__(self) -> int:
        return len(self.F)

    @property
    def packed_rows(self) -> FloatArray:
        """(P, 16) F by rows, e1, e2 and product side by side, for kernels."""
        return np.column_stack([self.F.reshape(-1, 9), self.e1, self.e2, self.product])


def pair_weights(inlier_counts: ArrayLike) -> FloatArray:
    """Return min(1, n / 300) for n inliers."""
    counts = np.asarray(inlier_counts, dtype=np.float64)
    return np.minimum(1.0, counts / FULL_WEIGHT_INLIERS)


def prepare(pairs: CameraPairs, *, unit_px: float, origin_px: tuple[float, float]) -> Pairs:
    """Check the pairs and express them in units of `unit_px` from the pixel `origin_px`.

    Pairs of weight 0 are left out; so is an F that repeats another, in either direction: it is no further evidence.

    Raises:
        ValueError: the pairs are malformed, see `check_pairs`.
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
        indices=used[distinct],
    )


def check_pairs(pairs: CameraPairs) -> tuple[FloatArray, FloatArray, IndexArray]:
    """Return matrices (Q, 3, 3), weights (Q,) and rows of the pairs with a weight; ValueError if malformed."""
    raw = np.asarray(pairs.Fs, dtype=np.float64)
    trust = np.asarray(pairs.weights, dtype=np.float64)
    if raw.size == 0:
        raw = raw.reshape(0, 3, 3)
    if raw.ndim != 3 or raw.shape[1:] != (3, 3):
        raise ValueError(f"fundamental matrices must have shape (P, 3, 3), not {raw.shape}")
    if trust.shape != (len(raw),):
        raise ValueError(f"weights must have shape ({len(raw)},), one per fundamental matrix, not {trust.shape}")
    if not np.all(np.isfinite(raw)):
        raise ValueError("fundamental matrices must be finite; one has NaN or infinity")
    if not np.all(np.isfinite(trust) & (trust >= 0)):
        raise ValueError("weights must be finite and >= 0")
    if np.any(np.all(raw == 0, axis=(1, 2))):
        raise ValueError("a fundamental matrix is zero")
    _check_photos(pairs, len(raw))
    used = np.flatnonzero(trust > 0)
    return raw[used], trust[used], used


def _check_photos(pairs: CameraPairs, count: int) -> None:
    size = pairs.size
    if len(size) != 2 or not all(np.isfinite(side) and side > 0 for side in size):
        raise ValueError(f"size must be (width, height) in pixels, both > 0, not {size}")
    for name, values in (("inliers", pairs.inliers), ("photos", pairs.photos)):
        if values and len(values) != count:
            raise ValueError(f"there are {count} fundamental matrices, but {name} of {len(values)} pairs")
    if any(x.ndim != 2 or x.shape[1] != 4 or not np.all(np.isfinite(x)) for x in map(np.asarray, pairs.inliers)):
        raise ValueError("inliers must have shape (N, 4) per pair and be finite")


def _distinct_indices(scaled: FloatArray) -> IndexArray:
    """Return the first row of all matrices that agree to 9 digits up to sign and transposition."""
    first: dict[bytes, int] = {}
    for index, F in enumerate(scaled):
        keys = [(np.round(sign * G, 9) + 0.0).tobytes() for sign in (1, -1) for G in (F, F.T)]
        first.setdefault(min(keys), index)
    return np.array(sorted(first.values()), dtype=np.int64)


# The lens, with one radial term (ours; the thesis has none), is COLMAP's SIMPLE_RADIAL. While the focal is sought, its
# parameter is kappa = k1 / f^2, with f and lengths in longer sides: the displacement of a point must not depend on the
# focal under trial.

LOG_FOCAL, CENTER_U, CENTER_V, LOG_ASPECT, KAPPA = range(5)
"""Parameters theta of a camera: log f with f = sqrt(fx fy), center from the middle, log fy/fx, kappa."""
LEAST_SLOPE = 0.2
"""Least slope of the distorted over the undistorted radius: a lens that would fold goes on with it, so that distances
do not jump while parameters change; by hand."""


@kernel
def write_camera(theta: FloatArray, camera: FloatArray) -> None:
    """Write fx, fy, cx, cy, k1 of the parameters (5,) into `camera` (5,)."""
    f, half = np.exp(theta[LOG_FOCAL]), np.exp(0.5 * theta[LOG_ASPECT])
    camera[FX], camera[FY], camera[CX], camera[CY] = f / half, f * half, theta[CENTER_U], theta[CENTER_V]
    camera[K1] = theta[KAPPA] * f * f


@kernel
def write_ray(x: float, y: float, camera: FloatArray, guess: float, out: FloatArray) -> None:
    """Write the ray of a pixel through a camera (5,) into `out` (10,), as `camera.projection.unproject_point`."""
    terms = (camera[K1], 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    end = (fold_radius(terms, PERSPECTIVE, LEAST_SLOPE), LEAST_SLOPE, 1.0 / LEAST_SLOPE)
    point = (x - camera[CX]) / camera[FX], (y - camera[CY]) / camera[FY]
    unproject_point(point, (camera[FX], camera[FY]), terms, PERSPECTIVE, end, guess, out)


@kernel
def undistort_kernel(points: FloatArray, theta: FloatArray) -> FloatArray:
    """Return (N, 2) undistorted points of a camera (5,); both count from the middle of the photo."""
    camera, out, straight = np.empty(5), np.empty(BEARING + 1), np.empty_like(points)
    write_camera(theta, camera)
    for i in range(len(points)):
        write_ray(points[i, 0], points[i, 1], camera, -1.0, out)
        straight[i, 0] = out[0] * camera[FX] + camera[CX]
        straight[i, 1] = out[1] * camera[FY] + camera[CY]
    return straight


GUESS = "guess"
ESTIMATE = "estimate"
"""Method of a camera that the photos determine roughly."""


def guess_calibration(size: tuple[int, int], reason: str, evidence: Mapping[str, float]) -> Calibration:
    """Return the usual guess, with the reason for the user and the evidence."""
    K = guessed_camera_matrix(size)
    return Calibration(K, *size, GUESS, identifiable=False, reason=reason, evidence=dict(evidence))


def claimed_calibration(
    prior: CameraPrior, size: tuple[int, int], reason: str, evidence: Mapping[str, float]
) -> Calibration:
    """Return the camera that someone claims, with the reason why the pairs do not determine it."""
    K = guessed_camera_matrix(size, prior.focal_px)
    spread = dict.fromkeys(("fx", "fy"), prior.focal_deviation_px)
    if prior.center_px is not None:
        K[:2, 2] = prior.center_px
        spread |= dict.fromkeys(("cx", "cy"), prior.center_deviation_px)
    if prior.k1 is not None:
        spread["k1"] = prior.k1_deviation
    return Calibration(
        K, *size, CLAIM, identifiable=False, reason=f"{reason}; {prior.source} claims this one".removeprefix("; "),
        distortion=(prior.k1 or 0.0,), spread=spread, evidence=dict(evidence),
    )  # fmt: skip


def calibration_from_parameters(
    theta: FloatArray, size: tuple[int, int], method: str, unit_px: float | None = None
) -> Calibration:
    """Return the calibration of theta (5,), in units of `unit_px` (the longer side for None) from the middle."""
    unit = unit_px or float(max(size))
    focal, half = float(np.exp(theta[LOG_FOCAL])), float(np.exp(0.5 * theta[LOG_ASPECT]))
    cx, cy = unit * theta[CENTER_U] + size[0] / 2, unit * theta[CENTER_V] + size[1] / 2
    K = camera_matrix(unit * focal / half, unit * focal * half, float(cx), float(cy))
    return Calibration(K, *size, method, identifiable=True, distortion=(float(theta[KAPPA]) * focal**2,))


def downgrade_to_estimate(calibration: Calibration, reason: str) -> Calibration:
    """Return the calibration as an estimate if there is a reason; unchanged for an empty reason."""
    return replace(calibration, identifiable=False, method=ESTIMATE, reason=reason) if reason else calibration


def parameters_from_calibration(calibration: Calibration, unit_px: float) -> FloatArray:
    """Return theta (5,), the inverse of `calibration_from_parameters`."""
    focal = calibration.focal_px / unit_px
    u, v = (
        (calibration.K[0, 2] - calibration.width / 2) / unit_px,
        (calibration.K[1, 2] - calibration.height / 2) / unit_px,
    )
    return np.array(
        [np.log(focal), u, v, np.log(calibration.K[1, 1] / calibration.K[0, 0]), calibration.radial / focal**2]
    )


def sides_from_pixels(size: tuple[int, int]) -> FloatArray:
    """Return the (3, 3) transform from pixels to longer sides from the middle of the photo."""
    side = float(max(size))
    return np.array([[1 / side, 0, -size[0] / 2 / side], [0, 1 / side, -size[1] / 2 / side], [0, 0, 1]])


def undistort_points(points: FloatArray, theta: FloatArray) -> FloatArray:
    """Return (N, 2) undistorted points of a camera (5,); both count from the middle of the photo."""
    return np.asarray(undistort_kernel(np.ascontiguousarray(points, np.float64), theta), np.float64)
