"""Panoramas of 360 degrees: recognition, and perspective views of them."""

import math
import re
from dataclasses import dataclass
from functools import partial
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from sfm_app.camera.bearings import RAY, bearings, project
from sfm_app.camera.models import panorama_matrix
from sfm_app.camera.perspective_views import PerspectiveView, cover_rays
from sfm_app.photos.decode import DecodedPhoto, UnreadableError
from sfm_app.types.arrays import FloatArray
from sfm_app.types.camera import EQUIRECTANGULAR, Calibration

# Recognize panoramas: equirectangular photos, whose columns are longitudes and whose rows are latitudes.
#
# Cameras and stitchers say so in the file (Google's Photo Sphere metadata, `GPano`). Without it, a full one is
# known by what no other picture has: it is twice as wide as high, its left and right borders continue each other,
# and its first and last row each show a single point, the zenith and the nadir.

XMP_KEYS = ("xmp", "XML:com.adobe.xmp")
"""Where Pillow keeps XMP in `Image.info`: JPEG and WebP, PNG."""
XMP_TIFF = 700
ENTRY = re.compile(rb"""<GPano:(\w+)[^>]*>([^<]*)</|GPano:(\w+)\s*=\s*["']([^"']*)""")
"""An entry of Google's metadata, as an element or as an attribute."""
WHOLE = 0.995
"""Least share of the sphere that counts as all of it: stitchers round. Chosen by hand; not measured on its own."""
ASPECT_TOLERANCE = 0.01
"""Largest error of the ratio of width to height, which is 2. Chosen by hand; not measured on its own."""
WIDTH_PX = 512
"""Width at which borders are compared. Chosen by hand; not measured on its own."""
SEAM_STEPS = 3.0
"""Largest difference of the border columns, in median differences of neighboring columns. Chosen on 2:1 parts of real
photos and on rendered panoramas: docs/algorithms.md, Panoramas."""
SEAM_SHARE = 0.5
"""Largest difference of the border columns, as a share of the least difference of one of them to any column an eighth
of a turn or more away. Chosen as `SEAM_STEPS`."""
LEAST_CONTRAST = 10.0
"""Standard deviation of a border column in gray levels, below which it cannot be told from others. Chosen by hand; not
measured on its own."""
POLE_SHARE = 0.2
"""Largest mean step from column to column of the first and the last row, as a share of that of the busiest row: a point
that is stretched over the whole width hardly changes. Chosen as `SEAM_STEPS`."""


def is_panorama(picture: DecodedPhoto, upright: Image.Image) -> bool:
    """Return whether a photo is a full equirectangular panorama, by its metadata or else by its pixels. Ours.

    Args:
        picture: what the file holds.
        upright: its picture, upright.

    Raises:
        UnreadableError: it is a panorama that does not show the whole sphere, or one of another projection.
    """
    entries = read_panorama_entries(picture.image)
    kind = entries.get("ProjectionType", "").strip().lower()
    if not kind:
        return closes_around(upright)
    if kind != "equirectangular":
        raise UnreadableError(f"a panorama of the projection '{kind[:40]}': only equirectangular ones can be used")
    wide, high = (_covered_share(entries, side) for side in ("Width", "Height"))
    if min(wide, high) < WHOLE:
        degrees = f"{360 * wide:.0f} x {180 * high:.0f} degrees"
        raise UnreadableError(f"a panorama of {degrees}: only full ones of 360 x 180 degrees can be used")
    if not _is_twice_as_wide(upright.size):
        raise UnreadableError("a part of a panorama: said to be all round, but not twice as wide as high")
    return True


def read_panorama_entries(image: Image.Image) -> dict[str, str]:
    """Return the entries of Google's Photo Sphere metadata by name; empty without.

    Args:
        image: decoded, as stored in the file.
    """
    found = next((image.info[key] for key in XMP_KEYS if image.info.get(key)), None)
    if found is None and image.format == "TIFF":
        found = getattr(image, "tag_v2", {}).get(XMP_TIFF)
    if isinstance(found, str):
        found = found.encode()
    if not isinstance(found, bytes):
        return {}
    entries = ((a or c, b or d) for a, b, c, d in ENTRY.findall(found))
    return {name.decode(): value.decode(errors="replace").strip() for name, value in entries}


def closes_around(upright: Image.Image) -> bool:
    """Return whether a picture looks like a full panorama: its borders continue each other, its poles are points. Ours.

    Args:
        upright: upright picture.
    """
    if not _is_twice_as_wide(upright.size):
        return False
    small = upright.convert("RGB").resize((WIDTH_PX, WIDTH_PX // 2), Image.Resampling.BOX, reducing_gap=3.0)
    pixels = np.asarray(small, np.float64)
    busy = np.abs(np.diff(pixels, axis=1)).mean(axis=(1, 2))
    return bool(max(busy[0], busy[-1]) <= POLE_SHARE * busy.max()) and _borders_continue(pixels)


def _borders_continue(pixels: NDArray[np.float64]) -> bool:
    """Return whether the last column continues in the first, and far better than in any other."""
    width, edge = pixels.shape[1], (pixels[:, :1], pixels[:, -1:])
    if min(float(np.std(column.mean(axis=2))) for column in edge) < LEAST_CONTRAST:
        return False
    seam = _difference(edge[0], edge[1])[0]
    steps = _difference(pixels[:, 1:], pixels[:, :-1])
    far = slice(width // 8, -(width // 8))
    others = min(_difference(column, pixels[:, far]).min() for column in edge)
    return bool(seam <= SEAM_STEPS * np.median(steps) and seam <= SEAM_SHARE * others)


def _difference(a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the mean absolute difference (N,) of columns (H, N, 3)."""
    return np.asarray(np.mean(np.abs(a - b), axis=(0, 2)), np.float64)


def _is_twice_as_wide(size: tuple[int, int]) -> bool:
    return abs(size[0] / size[1] - 2.0) <= ASPECT_TOLERANCE


def _covered_share(entries: dict[str, str], side: str) -> float:
    """Return the share of the sphere that the picture covers along its width or height, 1 where nothing is said."""
    try:
        part, whole = (float(entries[name]) for name in (f"CroppedAreaImage{side}Pixels", f"FullPano{side}Pixels"))
        return min(part / whole, 1.0) if part > 0 else 1.0
    except (KeyError, ValueError, ZeroDivisionError):
        return 1.0


# Photos sampled at other positions, such as those of a perspective view.

SEAM_PX = 4
"""Columns of the other border that are added at either one, for interpolation. Chosen by hand; not measured on its
own."""


def resample(
    photo: NDArray[np.uint8], at: NDArray[np.floating[Any]], size: tuple[int, int], wraps: bool = False
) -> NDArray[np.uint8]:
    """Return a photo (H, W, 3) at given positions, by cubic interpolation; beyond its border, the border is repeated.

    Args:
        photo: (h, w, 3), perhaps scaled down.
        at: (H, W, 2) pixels of the photo in its own size; centers at +0.5.
        size: (width, height) of the photo in its own size.
        wraps: whether its left and right border are the same place, as those of a panorama.
    """
    height, width = photo.shape[:2]
    x, y = (
        np.ascontiguousarray(at[..., axis] * (side / size[axis]) - 0.5, np.float32)
        for axis, side in enumerate((width, height))
    )
    if wraps:
        photo = cv2.copyMakeBorder(photo, 0, 0, SEAM_PX, SEAM_PX, cv2.BORDER_WRAP)
        x += SEAM_PX
    return np.asarray(cv2.remap(photo, x, y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE), np.uint8)


def shrink(photo: NDArray[np.uint8], share: float) -> NDArray[np.uint8]:
    """Return a photo (h, w, 3) scaled down by averaging, so that sampling it does not alias.

    Args:
        photo: (H, W, 3).
        share: of its size; with 1 or more it stays as it is.
    """
    if share >= 1.0:
        return photo
    size = max(1, round(photo.shape[1] * share)), max(1, round(photo.shape[0] * share))
    return np.asarray(cv2.resize(photo, size, interpolation=cv2.INTER_AREA), np.uint8)


# Look into a panorama through perspective views, where methods made for ordinary photos find features.
#
# An equirectangular photo stretches what is near its poles and cuts what lies at its borders; a view does neither.
# The views look through the corners of an icosahedron, and each is responsible for what lies nearer to its axis
# than to any other: so nothing is found twice where they overlap, at the borders of the panorama or elsewhere.
# Ours.

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


# The perspective views in which a panorama is painted onto a surface: the faces of a cube, in its own resolution.

GRID = 257
"""Rows and columns of a panorama whose rays are covered. Chosen by hand; not measured on its own."""


def panorama_parts(size: tuple[int, int]) -> list[PerspectiveView]:
    """Return the views of a panorama.

    Args:
        size: (width, height) of the panorama in pixels.
    """
    x, y = np.meshgrid(np.linspace(0.0, size[0], GRID), np.linspace(0.0, size[1], GRID))
    rays = bearings(np.column_stack([x.ravel(), y.ravel()]), _camera(size))[:, RAY]
    return cover_rays(rays, size[0] / (2.0 * np.pi), size[0])


def show_part(panorama: NDArray[np.uint8], part: PerspectiveView) -> NDArray[np.uint8]:
    """Return a view (h, w, 3) into a panorama.

    Args:
        panorama: (H, W, 3).
        part: the view.
    """
    height, width = panorama.shape[:2]
    at = part.locate(partial(project, camera=_camera((width, height))))
    return resample(panorama, at, (width, height), wraps=True)


def mask_part(used: NDArray[np.bool_], part: PerspectiveView) -> NDArray[np.bool_]:
    """Return (h, w) which pixels of a view into a panorama may be used.

    Args:
        used: (H, W) of the panorama.
        part: the view.
    """
    height, width = used.shape
    at = part.locate(partial(project, camera=_camera((width, height))))
    column, row = np.moveaxis(at.astype(np.int64), -1, 0)
    return np.asarray(used[row.clip(0, height - 1), column.clip(0, width - 1)])


def _camera(size: tuple[int, int]) -> Calibration:
    return Calibration(panorama_matrix(size), *size, "panorama", True, projection=EQUIRECTANGULAR)
