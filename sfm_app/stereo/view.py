"""Views of photos, their depth maps, the input of every depth-map method, and the neighbors of each view."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from sfm_app.geometry.epipolar import triangulation_angle_deg
from sfm_app.settings import DepthSettings
from sfm_app.tasks import ParallelMap
from sfm_app.types import PosedPhoto
from sfm_app.types.arrays import DepthArray, FloatArray, IndexArray

GrayImage = NDArray[np.uint8]
"""(H, W)."""
Kind = Literal["photometric", "geometric", "closed", "final"]
"""COLMAP's names for a depth map before and after the check against the other photos; closed cells; and maps with sharp
outlines before they replace the geometric ones."""


@dataclass(frozen=True, slots=True, eq=False)
class View(PosedPhoto):
    """A photo of the dense workspace, or a perspective view into one of a wide lens, with its sparse points."""

    point_ids: IndexArray = field(default_factory=lambda: np.empty(0, np.int64))
    """(M,) ids of the sparse points that this photo observes, ascending."""
    points: FloatArray = field(default_factory=lambda: np.empty((0, 3)))
    """(M, 3) those points in the world."""
    sample_px: float = 0.5
    """Position of a depth inside its pixel, in x and y: 0.5 is the pixel's center, 0 its top-left corner."""
    level: int = 0
    """Number of halvings of the photo."""

    @property
    def bare(self) -> "View":
        """The view without its sparse points, for other processes."""
        return replace(self, point_ids=np.empty(0, np.int64), points=np.empty((0, 3)))

    def projection_into(self, other: "View") -> FloatArray:
        """Return P (3, 4): the pixel (x, y) at depth z has the homogeneous pixel P (x z, y z, z, 1) in another view."""
        relative = other.R @ self.R.T
        pose = np.column_stack([relative @ np.linalg.inv(self.K), other.t - relative @ self.t])
        return np.asarray(other.K @ pose, np.float64)

    def halve(self, level: int) -> "View":
        """Return the view of the photo halved `level` >= 1 times; depths are at pixel centers."""
        width, height = (max(1, side >> level) for side in (self.width, self.height))
        return replace(self.resize(width, height), sample_px=0.5, level=level)


@dataclass(frozen=True, slots=True, eq=False)
class DepthMap:
    """Depths of one photo."""

    depth: DepthArray
    normals: NDArray[np.float32]
    """(H, W, 3) unit, camera frame, towards the camera; 0 where the depth is 0."""

    @classmethod
    def unknown(cls, view: View) -> "DepthMap":
        """Make a map without any depth."""
        return cls(np.zeros((view.height, view.width), np.float32), np.zeros((view.height, view.width, 3), np.float32))


@dataclass(frozen=True, slots=True, eq=False)
class DepthEstimate:
    """Depths of one photo before the check against other depth maps."""

    depth: DepthArray
    confidence: NDArray[np.float32]
    """(H, W) in [0, 1]: mean correlation with the better half of the neighbors; 0 where the depth is 0."""


class DepthStore(Protocol):
    """Reads photos and keeps maps; a map appears complete or not at all.

    Estimates are photometric, maps are geometric. Of a closed map, the cells that are not 0 are never filled.
    """

    def photo(self, view: View, /) -> GrayImage:
        """Return the photo without distortion, (H, W), at the size of the view."""

    def has(self, view: View, kind: Kind, /) -> bool: ...
    def read_estimate(self, view: View, /) -> DepthEstimate: ...
    def read_depth(self, view: View, kind: Kind = "photometric", /) -> DepthArray: ...
    def read_maps(self, view: View, /) -> DepthMap: ...
    def write_estimate(self, view: View, estimate: DepthEstimate, /) -> None: ...
    def write_maps(self, view: View, maps: DepthMap, /) -> None: ...
    def write_depth(self, view: View, depth: DepthArray, kind: Kind, /) -> None: ...


@dataclass(frozen=True, slots=True, eq=False)
class DepthTask:
    """The input of a depth-map method. Existing maps come from the same inputs and settings and are reused."""

    folder: Path
    """COLMAP's dense workspace with the undistorted photos and their model."""
    views: Sequence[View]
    ranked: Sequence[Sequence[int]]
    """For each view, the indices of its neighbors, best first."""
    options: DepthSettings
    store: DepthStore
    map: ParallelMap


def region(views: Sequence[View], margin: float = 0.2) -> FloatArray:
    """Return (2, 3) bounds of the sparse points without outliers, widened by a share of the longest side."""
    points = np.concatenate([view.points for view in views])
    low, high = np.percentile(points, [1, 99], axis=0)
    return np.stack([low - margin * (high - low).max(), high + margin * (high - low).max()])


BEST_ANGLE_DEG = 8.0
"""Best triangulation angle. Smaller angles give inexact depths, larger ones images that look different."""


def rank_neighbors(views: Sequence[View], count: int) -> list[list[int]]:
    """Rank at most `count` neighbors of every view by greedy coverage, best first.

    The next neighbor adds most to the sparse points of the view. A point adds its weight (triangulation angle,
    difference in scale), reduced by up to half per neighbor that covers it. So the neighbors cover the whole photo.
    """
    ids = np.concatenate([np.empty(0, np.int64), *(view.point_ids for view in views)])
    order = np.argsort(ids, kind="stable")
    observers = np.repeat(np.arange(len(views)), [len(view.point_ids) for view in views])[order]
    ids = ids[order]
    ranked = []
    for index, view in enumerate(views):
        ends = zip(*(np.searchsorted(ids, view.point_ids, side) for side in ("left", "right")), strict=True)
        others, shared = np.unique(
            np.concatenate([observers[:0], *(observers[a:b] for a, b in ends)]), return_counts=True
        )
        ranked.append(_rank(index, [k for k in others[shared >= 5] if k != index], views, count))
    return ranked


def _rank(index: int, others: Sequence[int], views: Sequence[View], count: int) -> list[int]:
    """Return the best neighbors of a view among others with common points."""
    view = views[index]
    weights: dict[int, FloatArray] = {}
    for number in map(int, others):
        other = views[number]
        angles = triangulation_angle_deg(view.points, view.center, other.center)
        if angles.max(initial=0.0) >= 1e-6:  # parts of one wide photo have the same center up to rounding
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


def point_weights(view: View, other: View, points: FloatArray) -> FloatArray:
    """Weigh points (N, 3) in the world by triangulation angle and scale: (N,) in [0, 1], 1 for the best match."""
    angle_deg = triangulation_angle_deg(points, view.center, other.center)
    spread_deg = np.where(angle_deg < BEST_ANGLE_DEG, BEST_ANGLE_DEG / 3, 1.25 * BEST_ANGLE_DEG)
    weight = np.exp(-0.5 * ((angle_deg - BEST_ANGLE_DEG) / spread_deg) ** 2)
    depth, other_depth = view.depths(points), other.depths(points)
    in_front = (depth > 0) & (other_depth > 0)
    scale = np.divide(view.K[0, 0] * other_depth, other.K[0, 0] * depth, out=np.ones_like(depth), where=in_front)
    return np.asarray(np.where(in_front, weight * np.minimum(scale, 1 / scale), 0.0))
