"""Look into a panorama through perspective views, where methods made for ordinary photos find features.

An equirectangular photo stretches what is near its poles and cuts what lies at its borders; a view does neither. The
views look through the corners of an icosahedron, and each is responsible for what lies nearer to its axis than to any
other: so nothing is found twice where they overlap, at the borders of the panorama or elsewhere. Ours.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sfm_app.geometry.camera import panorama_matrix
from sfm_app.geometry.lenses.bearings import project
from sfm_app.photos.resample import resample, shrink
from sfm_app.types.calibration import EQUIRECTANGULAR, Calibration

FloatArray = NDArray[np.float64]

FIELD_DEG = 90.0
"""Field of view along the sides. The farthest point that a view is responsible for lies 37 degrees from its axis, so
that the surroundings of every keypoint are inside. Chosen by hand; not measured on its own."""


@dataclass(frozen=True, slots=True, eq=False)
class PanoramaViews:
    """Square perspective views of a panorama that together show all of it."""

    size: tuple[int, int]
    """Width and height of the panorama in pixels."""
    side_px: int
    """Side of a view."""
    rotations: FloatArray
    """(V, 3, 3) from the panorama's frame to that of each view; x right, y down, z forward."""

    @classmethod
    def cover(cls, size: tuple[int, int], most_px: int) -> "PanoramaViews":
        """Return views in the panorama's own resolution, or in a lower one where that would make them too large.

        Args:
            size: width and height of the panorama in pixels.
            most_px: largest side of a view.
        """
        focal = size[0] / (2.0 * math.pi)
        side = 2.0 * focal * math.tan(math.radians(FIELD_DEG / 2.0))
        return cls(size, max(1, min(round(side), most_px)), view_rotations())

    @property
    def focal_px(self) -> float:
        """Focal length of the views in pixels."""
        return self.side_px / (2.0 * math.tan(math.radians(FIELD_DEG / 2.0)))

    def render(self, panorama: NDArray[np.uint8], view: int) -> NDArray[np.uint8]:
        """Return the picture (side, side, 3) of a view.

        Args:
            panorama: (H, W, 3), of the size of the panorama or smaller; see `shrink`.
            view: number of the view.
        """
        row, column = np.mgrid[: self.side_px, : self.side_px]
        at = self.to_panorama(np.column_stack([column.ravel(), row.ravel()]) + 0.5, view)
        return resample(panorama, at.reshape(self.side_px, self.side_px, 2), self.size, wraps=True)

    def shrink(self, panorama: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Return the panorama in the resolution of the views, so that they show it without aliasing.

        Args:
            panorama: (H, W, 3) of the size of the panorama.
        """
        return shrink(panorama, 2.0 * math.pi * self.focal_px / self.size[0])

    def to_panorama(self, x: FloatArray, view: int) -> FloatArray:
        """Return (N, 2) pixels of the panorama for pixels of a view.

        Args:
            x: (N, 2) pixels of the view.
            view: number of the view.
        """
        return project(self._rays(x, view), self._camera())

    def is_nearest(self, x: FloatArray, view: int) -> NDArray[np.bool_]:
        """Return (N,) whether a view is the one whose axis is nearest to each of its pixels.

        Args:
            x: (N, 2) pixels of the view.
            view: number of the view.
        """
        return np.asarray(np.argmax(self._rays(x, view) @ self.rotations[:, 2].T, axis=1) == view)

    def _rays(self, x: FloatArray, view: int) -> FloatArray:
        """Return (N, 3) rays of pixels of a view in the panorama's frame."""
        plain = np.column_stack([(x - self.side_px / 2.0) / self.focal_px, np.ones(len(x))])
        return np.asarray(plain @ self.rotations[view], np.float64)

    def _camera(self) -> Calibration:
        return Calibration(panorama_matrix(self.size), *self.size, "panorama", True, projection=EQUIRECTANGULAR)


def view_rotations() -> FloatArray:
    """Return (12, 3, 3) rotations from a panorama to views through the corners of an icosahedron, two at its poles."""
    latitude = math.atan(0.5)
    turns = 2.0 * math.pi / 5.0 * np.arange(5.0)
    rings = [_axes(turns + shift, tilt) for shift, tilt in ((0.0, latitude), (math.pi / 5.0, -latitude))]
    axes = np.concatenate([[[0.0, 1.0, 0.0], [0.0, -1.0, 0.0]], *rings])
    return np.stack([_look_along(axis) for axis in axes])


def _axes(longitude: FloatArray, latitude: float) -> FloatArray:
    """Return (N, 3) unit vectors; a positive latitude is below the horizon, as y points down."""
    level = math.cos(latitude)
    down = np.full(len(longitude), math.sin(latitude))
    return np.column_stack([level * np.sin(longitude), down, level * np.cos(longitude)])


def _look_along(axis: FloatArray) -> FloatArray:
    """Return the (3, 3) rotation into the frame of a view whose z is this axis, upright where that has a meaning."""
    down = np.array([0.0, 0.0, 1.0]) if abs(axis[1]) > 0.9 else np.array([0.0, 1.0, 0.0])
    right = np.cross(down, axis)
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(axis, right), axis])
