"""Views for texturing: lens and pose of a photo, and kernels that project and sample."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from sfm_app.errors import ReconstructionError
from sfm_app.jit import kernel
from sfm_app.types import CameraModel

FloatArray = NDArray[np.float64]

LENS = 8
"""COLMAP's OPENCV parameters fx, fy, cx, cy, k1, k2, p1, p2 come first in a camera row; the pose [R | t] follows."""
LEAST_SLOPE = 0.1
"""Smallest derivative of the distorted radius by the undistorted one; below it, the distortion is near its fold."""


@dataclass(frozen=True, slots=True, eq=False)
class PhotoView:
    """A registered photo and its camera."""

    name: str
    lens: tuple[float, ...]
    """fx, fy, cx, cy in pixels, k1, k2, p1, p2 as in COLMAP's OPENCV."""
    cam_from_world: FloatArray
    """(3, 4) [R | t]."""
    width: int
    height: int

    @property
    def row(self) -> FloatArray:
        """(20,) lens and pose for the kernels."""
        return np.concatenate([self.lens, self.cam_from_world.ravel()])

    @property
    def center(self) -> FloatArray:
        """(3,) center of projection in the world."""
        return np.asarray(-self.cam_from_world[:, :3].T @ self.cam_from_world[:, 3], np.float64)

    def with_size(self, width: int, height: int) -> "PhotoView":
        """Return the same view for a photo of another size.

        Args:
            width: pixels, > 0.
            height: pixels, > 0.
        """
        sx, sy = width / self.width, height / self.height
        fx, fy, cx, cy, *rest = self.lens
        return replace(self, lens=(fx * sx, fy * sy, cx * sx, cy * sy, *rest), width=width, height=height)


def photo_view(name: str, camera: CameraModel, cam_from_world: FloatArray) -> PhotoView:
    """Return the view of a registered photo.

    Args:
        name: of the photo.
        camera: of the model OPENCV.
        cam_from_world: (3, 4) [R | t].

    Raises:
        ReconstructionError: the camera has a model other than OPENCV, which every run uses for its cameras.
    """
    if camera.model != "OPENCV":
        raise ReconstructionError(f"the texture cannot use a camera of the model {camera.model}")
    return PhotoView(name, tuple(camera.params), cam_from_world, camera.width, camera.height)


@kernel
def project(camera: FloatArray, x: float, y: float, z: float) -> tuple[float, float, float]:
    """Project a world point: return its pixel and depth.

    All are 0 if the point is behind the camera or outside the valid range of the distortion.

    Args:
        camera: (20,) from `PhotoView.row`.
        x, y, z: in the world.
    """
    depth = camera[16] * x + camera[17] * y + camera[18] * z + camera[19]
    if depth <= 0.0:
        return 0.0, 0.0, 0.0
    u = (camera[8] * x + camera[9] * y + camera[10] * z + camera[11]) / depth
    v = (camera[12] * x + camera[13] * y + camera[14] * z + camera[15]) / depth
    k1, k2, p1, p2 = camera[4], camera[5], camera[6], camera[7]
    r2 = u * u + v * v
    if 1.0 + r2 * (3.0 * k1 + 5.0 * k2 * r2) < LEAST_SLOPE:
        return 0.0, 0.0, 0.0
    radial = 1.0 + r2 * (k1 + k2 * r2)
    ud = u * radial + 2.0 * p1 * u * v + p2 * (r2 + 2.0 * u * u)
    vd = v * radial + 2.0 * p2 * u * v + p1 * (r2 + 2.0 * v * v)
    return camera[0] * ud + camera[2], camera[1] * vd + camera[3], depth


@kernel
def sample(photo: NDArray[np.uint8], x: float, y: float, channel: int) -> float:
    """Return the bilinear value at a pixel position, clamped to the photo.

    Args:
        photo: (H, W, 3) RGB.
        x: pixels across; centers at +0.5.
        y: pixels down; centers at +0.5.
        channel: 0, 1 or 2.
    """
    height, width = photo.shape[0], photo.shape[1]
    x = min(max(x - 0.5, 0.0), width - 1.0)
    y = min(max(y - 0.5, 0.0), height - 1.0)
    left, top = int(x), int(y)
    right, below = min(left + 1, width - 1), min(top + 1, height - 1)
    a, b = x - left, y - top
    upper: float = (1.0 - a) * photo[top, left, channel] + a * photo[top, right, channel]
    lower: float = (1.0 - a) * photo[below, left, channel] + a * photo[below, right, channel]
    value: float = (1.0 - b) * upper + b * lower
    return value
