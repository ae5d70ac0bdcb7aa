"""Camera, pose and sparse points of a photo."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
DepthArray = NDArray[np.float32]
"""(H, W) depth along the optical axis in scene units, 0 where unknown."""
GrayImage = NDArray[np.uint8]
"""(H, W)."""


def _no_ids() -> NDArray[np.int64]:
    return np.empty(0, np.int64)


def _no_points() -> FloatArray:
    return np.empty((0, 3))


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """A posed photo without distortion: x ~ K (R X + t), pixel centers at +0.5."""

    name: str
    K: FloatArray
    """(3, 3) camera matrix in pixels; rows and columns may have different focal lengths, skew is allowed."""
    R: FloatArray
    """(3, 3) rotation of cam_from_world."""
    t: FloatArray
    """(3,) translation of cam_from_world."""
    width: int
    height: int
    point_ids: NDArray[np.int64] = field(default_factory=_no_ids)
    """(M,) ids of the sparse points that this photo observes, ascending."""
    points: FloatArray = field(default_factory=_no_points)
    """(M, 3) those points in the world."""
    sample_px: float = 0.5
    """Position of a depth inside its pixel, in x and y: 0.5 is the pixel's center, 0 its top-left corner."""
    level: int = 0
    """How many times the photo was halved."""

    @property
    def center(self) -> FloatArray:
        """(3,) center of projection in the world."""
        return np.asarray(-self.R.T @ self.t)

    @property
    def depths(self) -> FloatArray:
        """(M,) depths of the sparse points."""
        return np.asarray(self.points @ self.R[2] + self.t[2])

    @property
    def projection(self) -> FloatArray:
        """(3, 4) projection matrix K [R | t]."""
        return self.K @ np.column_stack([self.R, self.t])

    def halve(self, level: int) -> "View":
        """Return the view of the photo at half the size, and half of that, and so on; depths are at pixel centers.

        Args:
            level: how many times, >= 1.
        """
        width, height = (max(1, side >> level) for side in (self.width, self.height))
        scale = np.diag([width / self.width, height / self.height, 1.0])
        return replace(self, K=scale @ self.K, width=width, height=height, sample_px=0.5, level=level)


def region(views: Sequence[View], margin: float = 0.2) -> FloatArray:
    """Return (2, 3) lowest and highest coordinates of the sparse points without outliers, plus a margin.

    Args:
        views: with their sparse points.
        margin: share of the longest side added at every side.
    """
    points = np.concatenate([view.points for view in views])
    low, high = np.percentile(points, [1, 99], axis=0)
    return np.stack([low - margin * (high - low).max(), high + margin * (high - low).max()])
