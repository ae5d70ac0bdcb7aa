"""Two-view reconstructions that a mapping can start from."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sfm_app.geometry.essential import nearest_essential, relative_pose
from sfm_app.geometry.lenses.ray_epipolar import FIRST, SECOND, depths
from sfm_app.geometry.triangulation import triangulation_angle_deg

Array = NDArray[np.float64]

GOOD_ANGLE_DEG = 12.0
"""Wider angles than this make no better seed: depth is well determined already, and matches get rarer.
docs/algorithms.md, Mapping. Chosen by hand; halved and doubled by `benchmarks.sensitivity`."""


@dataclass(frozen=True, slots=True, eq=False)
class TwoViewSeed:
    """Pose of view 2 from view 1, and the points both see, in the frame of view 1 (baseline 1)."""

    R: Array
    t: Array
    points: Array
    """(N, 3), one per inlier, in the order given."""
    usable: NDArray[np.bool_]
    """(N,) whether a point is in front of both cameras and its triangulation angle determines its depth."""
    angle_deg: float
    """Median triangulation angle of the points in front of both cameras."""
    in_front: float
    """Share of the inliers that lie in front of both cameras, 0 to 1."""


def two_view_seed(E: Array, x1: Array, x2: Array) -> TwoViewSeed:
    """Decompose E and triangulate all its inliers.

    Args:
        E: (3, 3) with x2' E x1 = 0; the nearest essential matrix is used.
        x1: (N, 2) inliers as points of the plane z = 1, see `geometry.camera.rays`.
        x2: (N, 2) partners.
    """
    return _judge_seed(*relative_pose(nearest_essential(E), x1, x2))


def ray_seed(R: Array, t: Array, lines: Array) -> TwoViewSeed:
    """Return the seed of a pose, with each inlier at the point midway between its rays.

    Args:
        R: (3, 3) rotation of view 2 from view 1.
        t: (3,) unit vector along its translation.
        lines: (N, 18) inliers as bearing vectors, see `geometry.lenses.bearings`, view 1 and view 2.
    """
    first, second = depths(lines, R, t)
    X = 0.5 * (first[:, None] * lines[:, FIRST] + (second[:, None] * lines[:, SECOND] - t) @ R)
    return _judge_seed(R, t, X, (first > 0) & (second > 0))


def _judge_seed(R: Array, t: Array, X: Array, in_front: NDArray[np.bool_]) -> TwoViewSeed:
    angles = triangulation_angle_deg(X, np.zeros(3), -R.T @ t)
    angle = float(np.median(angles[in_front])) if in_front.any() else 0.0
    usable = in_front & (angles > min(1.0, angle / 4))
    return TwoViewSeed(R, t, X, usable, angle, float(in_front.mean()) if len(X) else 0.0)
