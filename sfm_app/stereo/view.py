"""Selection of the neighbors that a photo is matched with."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from sfm_app.types.arrays import FloatArray

# Camera, pose and sparse points of a photo.

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


MIN_SHARED_POINTS = 5
BEST_ANGLE_DEG = 8.0
"""Smaller angles give inexact depths, larger ones images that look different."""
SAME_PLACE_DEG = 1e-6
"""Views whose largest triangulation angle is smaller have the same center: they are parts of one wide photo. By
definition: rounding."""


def rank_neighbors(views: Sequence[View], count: int) -> list[list[int]]:
    """Return for every view the indices of its best neighbors, best first.

    Greedy coverage: the next neighbor is the one that adds most to the sparse points of the view. A point adds its
    weight (triangulation angle, difference in scale), reduced by up to half for each neighbor that already covers it.
    So the neighbors cover the whole photo instead of crowding on one side.

    Args:
        views: all photos, with their sparse points.
        count: most neighbors per view.
    """
    ids = np.concatenate([np.empty(0, np.int64), *(view.point_ids for view in views)])
    order = np.argsort(ids, kind="stable")
    seers = np.repeat(np.arange(len(views)), [len(view.point_ids) for view in views])[order]
    ranked = ids[order]
    found = []
    for index, view in enumerate(views):
        ends = zip(*(np.searchsorted(ranked, view.point_ids, side) for side in ("left", "right")), strict=True)
        others, shared = np.unique(np.concatenate([seers[:0], *(seers[a:b] for a, b in ends)]), return_counts=True)
        found.append(_rank(index, [k for k in others[shared >= MIN_SHARED_POINTS] if k != index], views, count))
    return found


def _rank(index: int, others: Sequence[int], views: Sequence[View], count: int) -> list[int]:
    """Return the best neighbors of a view among those that share points with it."""
    view = views[index]
    weights: dict[int, FloatArray] = {}
    for number in map(int, others):
        other = views[number]
        if not _is_same_place(view, other):
            shared = np.isin(view.point_ids, other.point_ids, assume_unique=True)
            weights[number] = np.where(shared, point_weights(view, other, view.points), 0.0)
    value, chosen = np.ones(len(view.point_ids)), list[int]()
    while weights and len(chosen) < count:
        # ties go to the lower index, so that the choice never depends on the order of a dictionary
        best = max(weights, key=lambda index: (float(weights[index] @ value), -index))
        weight = weights.pop(best)
        if weight @ value <= 0:
            break
        chosen.append(best)
        value *= 1.0 - 0.5 * weight
    return chosen


def _is_same_place(view: View, other: View) -> bool:
    angles = triangulation_angles_deg(view.center, other.center, view.points)
    return bool(angles.max(initial=0.0) < SAME_PLACE_DEG)


def point_weights(view: View, other: View, points: FloatArray) -> FloatArray:
    """Return (N,) in [0, 1]: how well points can be matched between two views, by angle and scale.

    Args:
        view: one view.
        other: the other one.
        points: (N, 3) in the world.
    """
    angle_deg = triangulation_angles_deg(view.center, other.center, points)
    spread_deg = np.where(angle_deg < BEST_ANGLE_DEG, BEST_ANGLE_DEG / 3, 1.25 * BEST_ANGLE_DEG)
    weight = np.exp(-0.5 * ((angle_deg - BEST_ANGLE_DEG) / spread_deg) ** 2)
    depth, other_depth = points @ view.R[2] + view.t[2], points @ other.R[2] + other.t[2]
    in_front = (depth > 0) & (other_depth > 0)
    scale = np.divide(view.K[0, 0] * other_depth, other.K[0, 0] * depth, out=np.ones_like(depth), where=in_front)
    return np.asarray(np.where(in_front, weight * np.minimum(scale, 1 / scale), 0.0))


def triangulation_angles_deg(center1: FloatArray, center2: FloatArray, points: FloatArray) -> NDArray[np.float64]:
    """Return (N,) angles in degrees between the rays from points to two centers.

    Args:
        center1: (3,) of one camera.
        center2: (3,) of the other.
        points: (N, 3).
    """
    ray1, ray2 = points - center1, points - center2
    # atan2 keeps small angles exact, where arccos of a rounded cosine does not
    sine = np.linalg.norm(np.cross(ray1, ray2), axis=1)
    return np.asarray(np.degrees(np.arctan2(sine, np.sum(ray1 * ray2, axis=1))))
