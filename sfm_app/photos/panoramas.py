"""Panoramas of 360 degrees: recognition, and perspective views of them."""

import math
from dataclasses import dataclass
from functools import partial
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from sfm_app.camera.bearings import bearings, project
from sfm_app.camera.models import panorama_camera
from sfm_app.camera.perspective_views import PerspectiveView, cover_rays
from sfm_app.camera.projection import RAY
from sfm_app.photos.decode import DecodedPhoto, UnreadableError, xmp_entries
from sfm_app.types.arrays import BoolArray, ByteArray, FloatArray

# Recognition of equirectangular photos, whose columns are longitudes and whose rows are latitudes. Ours.
# Cameras and stitchers name the projection in the file (Google's Photo Sphere metadata, `GPano`). Without metadata, a
# full panorama is twice as wide as high, its left and right borders continue each other, and its first and last row
# each show one point: zenith and nadir.


class OPTIONS:
    """Constants of panoramas. Recognition: chosen on 2:1 parts of real photos and on rendered panoramas."""

    whole: float = 0.995
    """Least share of the sphere that counts as all of it: stitchers round. Chosen by hand."""
    aspect_tolerance: float = 0.01
    """Largest error of the ratio of width to height, which is 2. Chosen by hand."""
    width_px: int = 512
    """Width at which borders are compared. Chosen by hand."""
    seam_steps: float = 3.0
    """Largest difference of the border columns, in median differences of neighboring columns."""
    seam_share: float = 0.5
    """Largest such difference, as a share of the least difference to a column an eighth of a turn or more away."""
    min_contrast: float = 10.0
    """Least standard deviation of a border column, in gray levels. Chosen by hand."""
    pole_share: float = 0.2
    """Largest mean step between columns in the first and last row, as a share of the row with the largest steps."""
    seam_px: int = 4
    """Columns of the other border that are added for interpolation. Chosen by hand."""
    field_deg: float = 80.0
    """Field of view of a feature view. The farthest point nearest to a view's axis lies 37 degrees from it, so that
    the surroundings of most keypoints are inside. Chosen by hand."""
    grid: int = 257
    """Rows and columns of a panorama whose rays the painted views cover. Chosen by hand."""


def is_panorama(picture: DecodedPhoto, upright: Image.Image) -> bool:
    """Return whether a photo is a full panorama; raise an UnreadableError for another projection or a part of one."""
    entries = read_panorama_entries(picture.image)
    kind = entries.get("ProjectionType", "").strip().lower()
    if not kind:
        return looks_like_panorama(upright)
    if kind != "equirectangular":
        raise UnreadableError(f"a panorama of the projection '{kind[:40]}': only equirectangular ones can be used")
    wide, high = (_covered_share(entries, side) for side in ("Width", "Height"))
    if min(wide, high) < OPTIONS.whole:
        degrees = f"{360 * wide:.0f} x {180 * high:.0f} degrees"
        raise UnreadableError(f"a panorama of {degrees}: only full ones of 360 x 180 degrees can be used")
    if not _is_twice_as_wide(upright.size):
        raise UnreadableError("a part of a panorama: it is not twice as wide as high")
    return True


def read_panorama_entries(image: Image.Image) -> dict[str, str]:
    """Return the entries of Google's Photo Sphere metadata of a decoded image by name; empty without."""
    return {name[6:]: value for name, value in xmp_entries(image).items() if name.startswith("GPano:")}


def looks_like_panorama(upright: Image.Image) -> bool:
    """Return whether an upright picture looks like a full panorama: borders continue, poles are points."""
    if not _is_twice_as_wide(upright.size):
        return False
    small = upright.convert("RGB").resize(
        (OPTIONS.width_px, OPTIONS.width_px // 2), Image.Resampling.BOX, reducing_gap=3.0
    )
    pixels = np.asarray(small, np.float64)
    steps = np.abs(np.diff(pixels, axis=1)).mean(axis=(1, 2))
    return bool(max(steps[0], steps[-1]) <= OPTIONS.pole_share * steps.max()) and _borders_continue(pixels)


def _borders_continue(pixels: FloatArray) -> bool:
    """Return whether the last column continues in the first, and far better than in any other."""
    width, edge = pixels.shape[1], (pixels[:, :1], pixels[:, -1:])
    if min(float(np.std(column.mean(axis=2))) for column in edge) < OPTIONS.min_contrast:
        return False
    seam = _difference(edge[0], edge[1])[0]
    steps = _difference(pixels[:, 1:], pixels[:, :-1])
    far = slice(width // 8, -(width // 8))
    others = min(_difference(column, pixels[:, far]).min() for column in edge)
    return bool(seam <= OPTIONS.seam_steps * np.median(steps) and seam <= OPTIONS.seam_share * others)


def _difference(a: FloatArray, b: FloatArray) -> FloatArray:
    """Return the mean absolute difference (N,) of columns (H, N, 3)."""
    return np.asarray(np.mean(np.abs(a - b), axis=(0, 2)), np.float64)


def _is_twice_as_wide(size: tuple[int, int]) -> bool:
    return abs(size[0] / size[1] - 2.0) <= OPTIONS.aspect_tolerance


def _covered_share(entries: dict[str, str], side: str) -> float:
    """Return the share of the sphere that the picture covers along its "Width" or "Height"; 1 if unknown."""
    try:
        part, whole = (float(entries[name]) for name in (f"CroppedAreaImage{side}Pixels", f"FullPano{side}Pixels"))
        return min(part / whole, 1.0) if part > 0 else 1.0
    except (KeyError, ValueError, ZeroDivisionError):
        return 1.0


def resample(photo: ByteArray, at: NDArray[np.floating[Any]], size: tuple[int, int], wraps: bool = False) -> ByteArray:
    """Return a photo (H, W, 3) at given positions by cubic interpolation; outside, the border is repeated.

    `at` (H, W, 2) are pixels of the photo at its own size (width, height), centers at +0.5; it may be scaled down. With
    `wraps`, its left border continues the right one, as in a panorama.
    """
    height, width = photo.shape[:2]
    x, y = (
        np.ascontiguousarray(at[..., axis] * (side / size[axis]) - 0.5, np.float32)
        for axis, side in enumerate((width, height))
    )
    if wraps:
        photo = cv2.copyMakeBorder(photo, 0, 0, OPTIONS.seam_px, OPTIONS.seam_px, cv2.BORDER_WRAP)
        x += OPTIONS.seam_px
    return np.asarray(cv2.remap(photo, x, y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE), np.uint8)


def shrink(photo: ByteArray, share: float) -> ByteArray:
    """Return a photo (H, W, 3) scaled down to a share of its size by averaging, to avoid aliasing; never enlarged."""
    if share >= 1.0:
        return photo
    size = max(1, round(photo.shape[1] * share)), max(1, round(photo.shape[0] * share))
    return np.asarray(cv2.resize(photo, size, interpolation=cv2.INTER_AREA), np.uint8)


# Feature views: perspective views in which feature methods meet neither the stretched poles nor the cut borders.
# Their axes pass through the corners of an icosahedron. Each view owns the directions nearest to its axis, so that
# no feature is found twice. Ours.


@dataclass(frozen=True, slots=True, eq=False)
class PanoramaViews:
    """Square perspective views of a panorama that together show all of it."""

    size: tuple[int, int]
    """Width and height of the panorama in pixels."""
    side_px: int
    rotations: FloatArray
    """(V, 3, 3) from the panorama's frame to that of each view; x right, y down, z forward."""

    @classmethod
    def cover(cls, size: tuple[int, int], most_px: int) -> "PanoramaViews":
        """Return views of a panorama (width, height) in its resolution, with at most 6 `most_px`^2 pixels together."""
        focal = size[0] / (2.0 * math.pi)
        side = 2.0 * focal * math.tan(math.radians(OPTIONS.field_deg / 2.0))
        return cls(size, max(1, round(min(side, most_px / math.sqrt(2.0)))), view_rotations())

    @property
    def focal_px(self) -> float:
        """Focal length of the views in pixels."""
        return self.side_px / (2.0 * math.tan(math.radians(OPTIONS.field_deg / 2.0)))

    def render(self, panorama: ByteArray, view: int) -> ByteArray:
        """Return the picture (side, side, 3) of a view of the panorama (H, W, 3), possibly scaled by `shrink`."""
        row, column = np.mgrid[: self.side_px, : self.side_px]
        at = self.to_panorama(np.column_stack([column.ravel(), row.ravel()]) + 0.5, view)
        return resample(panorama, at.reshape(self.side_px, self.side_px, 2), self.size, wraps=True)

    def shrink(self, panorama: ByteArray) -> ByteArray:
        """Return the panorama (H, W, 3) in the resolution of the views, to avoid aliasing."""
        return shrink(panorama, 2.0 * math.pi * self.focal_px / self.size[0])

    def to_panorama(self, x: FloatArray, view: int) -> FloatArray:
        """Return (N, 2) pixels of the panorama for (N, 2) pixels of a view."""
        return project(self._rays(x, view), panorama_camera(self.size))

    def is_nearest(self, x: FloatArray, view: int) -> BoolArray:
        """Return (N,) whether no other view's axis is nearer to each of the (N, 2) pixels of a view."""
        return np.asarray(np.argmax(self._rays(x, view) @ self.rotations[:, 2].T, axis=1) == view)

    def _rays(self, x: FloatArray, view: int) -> FloatArray:
        """Return (N, 3) rays of pixels of a view in the panorama's frame."""
        plain = np.column_stack([(x - self.side_px / 2.0) / self.focal_px, np.ones(len(x))])
        return np.asarray(plain @ self.rotations[view], np.float64)


def view_rotations() -> FloatArray:
    """Return (12, 3, 3) rotations from a panorama to views through the corners of an icosahedron, two at its poles."""
    latitude = math.atan(0.5)
    turns = 2.0 * math.pi / 5.0 * np.arange(5.0)
    rings = [_axes(turns + shift, tilt) for shift, tilt in ((0.0, latitude), (math.pi / 5.0, -latitude))]
    axes = np.concatenate([[[0.0, 1.0, 0.0], [0.0, -1.0, 0.0]], *rings])
    rotations = []
    for axis in axes:  # upright, except at the poles
        down = np.array([0.0, 0.0, 1.0]) if abs(axis[1]) > 0.9 else np.array([0.0, 1.0, 0.0])
        right = np.cross(down, axis)
        right /= np.linalg.norm(right)
        rotations.append(np.stack([right, np.cross(axis, right), axis]))
    return np.stack(rotations)


def _axes(longitude: FloatArray, latitude: float) -> FloatArray:
    """Return (N, 3) unit vectors; a positive latitude is below the horizon, as y points down."""
    level = math.cos(latitude)
    down = np.full(len(longitude), math.sin(latitude))
    return np.column_stack([level * np.sin(longitude), down, level * np.cos(longitude)])


def panorama_parts(size: tuple[int, int]) -> list[PerspectiveView]:
    """Return the texture views of a panorama of (width, height): faces of a cube, in its own resolution."""
    x, y = np.meshgrid(np.linspace(0.0, size[0], OPTIONS.grid), np.linspace(0.0, size[1], OPTIONS.grid))
    rays = bearings(np.column_stack([x.ravel(), y.ravel()]), panorama_camera(size))[:, RAY]
    return cover_rays(rays, size[0] / (2.0 * np.pi), size[0])


def show_part(panorama: ByteArray, part: PerspectiveView) -> ByteArray:
    """Return the picture (h, w, 3) of a view of a panorama (H, W, 3)."""
    height, width = panorama.shape[:2]
    at = part.locate(partial(project, camera=panorama_camera((width, height))))
    return resample(panorama, at, (width, height), wraps=True)


def mask_part(used: BoolArray, part: PerspectiveView) -> BoolArray:
    """Return the usable pixels (h, w) of a view of a panorama with usable pixels (H, W)."""
    height, width = used.shape
    at = part.locate(partial(project, camera=panorama_camera((width, height))))
    column, row = np.moveaxis(at.astype(np.int64), -1, 0)
    return np.asarray(used[row.clip(0, height - 1), column.clip(0, width - 1)])
