"""Culling: which points or triangles a camera can have in view, without looking at each of them.

They are put into clusters of neighbors, each in a ball; a camera looks at those whose ball reaches into its cone.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
IndexArray = NDArray[np.int64]

CLUSTER = 256
"""Members of a cluster. Chosen by hand: of 100 000 triangles, the 400 balls are tested in no time."""
CURVE_BITS = 12
"""Cells along a side of the grid of the Morton curve, as a power of two. Chosen by hand."""
SLACK = 1e-6
"""Radians, and share of a ball's radius, by which rounding may be off. By definition."""


@dataclass(frozen=True, slots=True, eq=False)
class Clusters:
    """Points or triangles in clusters of neighbors."""

    order: IndexArray
    """(N,) members, cluster after cluster."""
    starts: IndexArray
    """(C + 1,) first member of each cluster in `order`."""
    centers: FloatArray
    """(C, 3) of the balls."""
    radii: FloatArray
    """(C,) of the balls, which contain all corners of their members."""

    def find_in_cone(self, apex: FloatArray, axis: FloatArray, half_angle: float) -> IndexArray:
        """Return (M,) the members, ascending, of all clusters that reach into a cone; it misses none inside.

        Args:
            apex: (3,) center of the camera.
            axis: (3,) unit vector along which it looks.
            half_angle: of the cone, in radians, up to pi.
        """
        way = self.centers - apex
        distance = np.linalg.norm(way, axis=1)
        radii = self.radii * (1.0 + SLACK) + SLACK * distance
        outside = distance > radii
        angle = np.arctan2(np.linalg.norm(np.cross(way, axis), axis=1), way @ axis)
        reach = np.arcsin(np.clip(np.divide(radii, distance, out=np.ones_like(radii), where=outside), 0.0, 1.0))
        near = np.flatnonzero(~outside | (angle - reach <= half_angle + SLACK))
        if not len(near):
            return np.empty(0, np.int64)
        return np.sort(np.concatenate([self.order[self.starts[k] : self.starts[k + 1]] for k in near]))


def cluster(corners: FloatArray) -> Clusters:
    """Put points or triangles into clusters.

    Args:
        corners: (N, K, 3) of each member; K is 1 for points and 3 for triangles.
    """
    order = morton_order(corners.mean(axis=1))
    starts = np.append(np.arange(0, len(order), CLUSTER), len(order)).astype(np.int64)
    if not len(order):
        return Clusters(order, np.zeros(1, np.int64), np.empty((0, 3)), np.empty(0))
    lowest = np.minimum.reduceat(corners.min(axis=1)[order], starts[:-1])
    highest = np.maximum.reduceat(corners.max(axis=1)[order], starts[:-1])
    centers = 0.5 * (lowest + highest)
    own = np.repeat(centers, np.diff(starts), axis=0)[:, None, :]
    radii = np.maximum.reduceat(np.linalg.norm(corners[order] - own, axis=2).max(axis=1), starts[:-1])
    return Clusters(order, starts, centers, radii)


def morton_order(points: FloatArray) -> IndexArray:
    """Return the Morton order (N,) of points (N, 3), in which nearby points are mostly adjacent (Morton 1966)."""
    low = points.min(axis=0, initial=np.inf)
    span = max(float(np.max(points.max(axis=0, initial=-np.inf) - low, initial=0.0)), 1e-300)
    grid = ((points - low) / span * (2**CURVE_BITS - 1)).astype(np.int64)
    code = np.zeros(len(points), np.int64)
    for bit in range(CURVE_BITS):
        for axis in range(3):
            code |= ((grid[:, axis] >> bit) & 1) << (3 * bit + axis)
    return np.argsort(code, kind="stable")


def border_angle(K: FloatArray, width: float, height: float) -> float:
    """Return the largest angle in radians between the optical axis and what a photo without distortion shows.

    Args:
        K: (3, 3) camera matrix in pixels.
        width: of the photo in pixels.
        height: of the photo in pixels.
    """
    corners = np.array([[x, y, 1.0] for x in (-1.0, width + 1.0) for y in (-1.0, height + 1.0)])
    rays = np.linalg.solve(K, corners.T).T
    return float(np.arctan2(np.linalg.norm(rays[:, :2], axis=1), rays[:, 2]).max())
