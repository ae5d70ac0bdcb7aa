"""Triangulation of points from two views."""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def triangulate(P1: Array, P2: Array, x1: Array, x2: Array) -> Array:
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
        points: Array = X[:, :3] / X[:, 3:]
    points[~np.isfinite(points).all(axis=1)] = np.inf
    return points


def triangulation_angle_deg(X: Array, center1: Array, center2: Array) -> Array:
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
    angles: Array = np.degrees(np.arccos(np.clip(np.nan_to_num(cosine, nan=1.0), -1.0, 1.0)))
    return angles
