"""Perspective views that together show a photo of a wide lens. Ours.

Depth maps and texture are made from perspective photos. One perspective photo cannot show 180 degrees, and stretches
things far from its axis long before.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from sfm_app.camera.models import camera_matrix
from sfm_app.types.arrays import Float32Array, FloatArray


class OPTIONS:
    """Sizes of perspective views."""

    most_field_deg: float = 95.0
    """Largest side of a view without its overlap; its border shows things 2.2 times as large. Chosen by hand."""
    overlap_deg: float = 4.0
    """Angle beyond the view's own part: windows and triangles at the border are whole in one view. Chosen by hand."""
    cube_field_deg: float = 300.0
    """Horizontal field above which a photo is a panorama, with views through the faces of a cube. Chosen by hand."""


@dataclass(frozen=True, slots=True, eq=False)
class PerspectiveView:
    """A view into a photo from the same center."""

    R: FloatArray
    """(3, 3) from the photo's frame to that of the view; x right, y down, z forward."""
    K: FloatArray
    """(3, 3) camera matrix in pixels of the view."""
    width: int
    height: int

    def locate(self, project: Callable[[FloatArray], FloatArray]) -> Float32Array:
        """Return the pixels (height, width, 2) of the photo that the view shows; `project` takes rays (N, 3)."""
        pixels = np.empty((self.height, self.width, 2), np.float32)
        strip = 256  # rows that are projected at once, so that memory stays small
        for top in range(0, self.height, strip):
            rays = self.rays(top, top + strip)
            pixels[top : top + strip] = project(rays.reshape(-1, 3)).reshape(*rays.shape[:2], 2)
        return pixels

    def rays(self, top: int = 0, bottom: int | None = None) -> FloatArray:
        """Return the rays (rows, width, 3) of the centers of pixels in rows top to bottom, in the photo's frame."""
        rows = np.arange(self.height)[top:bottom]
        x, y = np.meshgrid(np.arange(self.width) + 0.5, rows + 0.5)
        local = np.stack([(x - self.K[0, 2]) / self.K[0, 0], (y - self.K[1, 2]) / self.K[1, 1], np.ones_like(x)], -1)
        return np.asarray(local @ self.R, np.float64)


def cover_rays(rays: FloatArray, focal_px: float, most_px: int) -> list[PerspectiveView]:
    """Return perspective views that together show all rays (N, 3) of a photo; rays are dense over its field.

    Sides have at most `most_px`; the focal length is smaller where a view would become too large.
    """
    axes = _axes(rays)
    nearest = np.argmax(rays @ axes[:, 2].T, axis=1)
    views = [_fit_view(axis, rays[nearest == k], focal_px, most_px) for k, axis in enumerate(axes)]
    return [view for view in views if view is not None]


def center_view(view: PerspectiveView) -> PerspectiveView:
    """Return the view turned to the center of its field, with square pixels and the optical center in the middle."""
    middle = np.linalg.solve(view.K, [view.width / 2, view.height / 2, 1.0])
    length = float(np.linalg.norm(middle))
    x, y, z = middle / length
    mixed = -x * y / (1.0 + z)
    rotation = np.array([[1.0 - x * x / (1.0 + z), mixed, -x], [mixed, 1.0 - y * y / (1.0 + z), -y], [x, y, z]])
    focal = float(np.sqrt(view.K[0, 0] * view.K[1, 1])) * length
    size = np.array([view.width / view.K[0, 0], view.height / view.K[1, 1]]) * focal
    corners = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)]) * size / (2.0 * focal)

    def fits(share: float) -> bool:
        projected = np.column_stack([share * corners, np.ones(4)]) @ rotation @ view.K.T
        pixels = projected[:, :2] / projected[:, 2:]
        return bool(
            (projected[:, 2] > 0.0).all() and (pixels >= 0.0).all() and (pixels <= [view.width, view.height]).all()
        )

    low, high = 0.0, 2.0
    for _ in range(50):  # as many halvings as numbers in double precision have bits
        low, high = ((low + high) / 2, high) if fits((low + high) / 2) else (low, (low + high) / 2)
    # rounding may make a view smaller that is centered already
    width, height = (max(1, int(side + 1e-6)) for side in low * size)
    return PerspectiveView(rotation @ view.R, camera_matrix(focal, focal, width / 2, height / 2), width, height)


def _axes(rays: FloatArray) -> FloatArray:
    """Return rotations (V, 3, 3) into views of equal parts of the angles of the rays."""
    longitude, latitude = np.arctan2(rays[:, 0], rays[:, 2]), np.arcsin(np.clip(rays[:, 1], -1.0, 1.0))
    if np.degrees(np.ptp(longitude)) > OPTIONS.cube_field_deg:
        turns = [_rotation(0.5 * np.pi * k, 0.0) for k in range(4)]
        return np.stack([*turns, _rotation(0.0, 0.5 * np.pi), _rotation(0.0, -0.5 * np.pi)])
    yaws, pitches = _centers(longitude), _centers(latitude)
    return np.stack([_rotation(yaw, pitch) for pitch in pitches for yaw in yaws])


def _centers(angles: FloatArray) -> FloatArray:
    """Return the centers of as few equal parts of a range of angles as views can show."""
    low, high = float(angles.min()), float(angles.max())
    count = max(1, int(np.ceil(np.degrees(high - low) / OPTIONS.most_field_deg)))
    return np.asarray(low + (high - low) * (np.arange(count) + 0.5) / count, np.float64)


def _rotation(yaw: float, pitch: float) -> FloatArray:
    """Return the (3, 3) rotation into a view turned right by yaw, then down by pitch, in radians."""
    level = np.array([[np.cos(yaw), 0.0, -np.sin(yaw)], [0.0, 1.0, 0.0], [np.sin(yaw), 0.0, np.cos(yaw)]])
    tilt = np.array([[1.0, 0.0, 0.0], [0.0, np.cos(pitch), -np.sin(pitch)], [0.0, np.sin(pitch), np.cos(pitch)]])
    return np.asarray(tilt @ level, np.float64)


def _fit_view(R: FloatArray, rays: FloatArray, focal_px: float, most_px: int) -> PerspectiveView | None:
    """Return the smallest view with this axis that shows some rays; None without rays."""
    if not len(rays):
        return None
    local = rays @ R.T
    slopes = np.arctan(local[:, :2] / local[:, 2:])
    reach = np.radians(OPTIONS.overlap_deg)
    low, high = np.tan(slopes.min(axis=0) - reach), np.tan(slopes.max(axis=0) + reach)
    focal = min(focal_px, most_px / float((high - low).max()))
    width, height = (max(1, int(side)) for side in np.ceil(focal * (high - low)).clip(max=most_px))
    return PerspectiveView(R, camera_matrix(focal, focal, -focal * low[0], -focal * low[1]), width, height)
