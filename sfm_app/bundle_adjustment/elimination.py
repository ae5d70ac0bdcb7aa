"""Parts of the Schur complement: points whitened by their observations, and the gauge."""

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]

POSE = 6
"""Number of parameters of a pose. By definition."""
MIN_INFORMATION = 1e-11
"""Share of a point's information below which a direction counts as undetermined: rounding leaves this much of the depth
of rays that nearly coincide. Two rays 1.5 degrees apart leave 2e-4. Chosen on no set. docs/algorithms.md, Bundle
adjustment."""


def whiten_points(by_point: FloatArray, point: NDArray[np.int64], points: int) -> tuple[FloatArray, NDArray[np.int64]]:
    """Return W (P, 3, 3) that makes derivatives by W^-T X orthonormal over the observations of a point, and its rank.

    Along directions that the observations do not determine, W is 0.

    Args:
        by_point: (N, 2, 3) weighted derivatives of the observations by their points.
        point: (N,) row of the point of each observation.
        points: P.
    """
    H = np.zeros((points, 3, 3))
    products = np.einsum("nki,nkj->nij", by_point, by_point)
    for i in range(3):
        for j in range(3):
            H[:, i, j] = np.bincount(point, products[:, i, j], points)
    diagonal = np.einsum("pii->pi", H)
    scale = np.sqrt(np.where(diagonal > 0.0, diagonal, 1.0))
    unit = H / (scale[:, :, None] * scale[:, None, :])
    # the pivots of the Cholesky decomposition
    second = unit[:, 1, 1] - unit[:, 1, 0] ** 2
    across = unit[:, 2, 1] - unit[:, 2, 0] * unit[:, 1, 0]
    third = unit[:, 2, 2] - unit[:, 2, 0] ** 2 - across**2 / np.maximum(second, MIN_INFORMATION)
    fixed = (unit[:, 0, 0] > 0.0) & (second > MIN_INFORMATION) & (third > MIN_INFORMATION)
    W, rank = np.zeros((points, 3, 3)), np.full(points, 3)
    W[fixed] = np.linalg.inv(np.linalg.cholesky(H[fixed]))
    values, vectors = np.linalg.eigh(unit[~fixed])
    kept = values > MIN_INFORMATION
    gains = np.where(kept, np.where(kept, values, 1.0) ** -0.5, 0.0)
    W[~fixed] = gains[:, :, None] * vectors.transpose(0, 2, 1) / scale[~fixed, None, :]
    rank[~fixed] = np.count_nonzero(kept, axis=1)
    return W, rank


def free_pose_columns(R: FloatArray, t: FloatArray) -> NDArray[np.int64]:
    """Return the free pose columns when the gauge is fixed: the first photo, and one coordinate of the farthest one.

    Args:
        R, t: (I, 3, 3) and (I, 3) camera from world.
    """
    centers = -np.einsum("nji,nj->ni", R, t)
    far = int(np.argmax(np.linalg.norm(centers - centers[0], axis=1)))
    relative = R[far] @ (centers[0] - centers[far])
    held = {POSE * far + 3 + int(np.argmax(np.abs(relative)))} | set(range(POSE))
    return np.array([k for k in range(POSE * len(R)) if k not in held], np.int64)
