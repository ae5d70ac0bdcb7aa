"""A photo at some resolution, with its gradients."""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
Gray = NDArray[np.float32]

BLUR_PX = 0.6
"""Standard deviation of the blur before gradients are taken: less leaves noise, more loses detail. Chosen on the scene
`ornament`; not measured on its own."""


@dataclass(frozen=True, slots=True, eq=False)
class RefinePhoto:
    """A posed photo without distortion, x ~ K (R X + t), pixel centers at +0.5."""

    K: FloatArray
    """(3, 3) camera matrix in pixels."""
    R: FloatArray
    """(3, 3) rotation of cam_from_world."""
    t: FloatArray
    """(3,) translation of cam_from_world."""
    gray: NDArray[np.uint8]
    """(H, W)."""
    masked: NDArray[np.bool_] | None = None
    """(H, W) what a mask leaves out; None without a mask."""

    @property
    def center(self) -> FloatArray:
        """(3,) center of projection in the world."""
        return np.asarray(-self.R.T @ self.t)

    @property
    def focal_px(self) -> float:
        """Pixels per unit of length at depth 1, the mean of both directions."""
        return float(np.sqrt(self.K[0, 0] * self.K[1, 1]))

    def size_at(self, share: float) -> tuple[int, int]:
        """Return height and width at a share of the full resolution."""
        height, width = self.gray.shape
        return max(2, round(share * height)), max(2, round(share * width))

    def projection(self, share: float) -> FloatArray:
        """Return the (3, 4) projection matrix at a share of the full resolution."""
        (height, width), full = self.size_at(share), self.gray.shape
        scale = np.diag([width / full[1], height / full[0], 1.0])
        return np.asarray(scale @ self.K @ np.column_stack([self.R, self.t]))

    def mask_at(self, share: float) -> NDArray[np.bool_] | None:
        """Return the mask at a share of the full resolution: pixels of which any part is left out."""
        if self.masked is None:
            return None
        size = self.size_at(share)[::-1]
        return np.asarray(cv2.resize(self.masked.astype(np.float32), size, interpolation=cv2.INTER_AREA) > 0)

    def level(self, share: float) -> "PhotoLevel":
        """Return the photo at a share of its resolution, smoothed, with its gradients."""
        height, width = self.size_at(share)
        small = self.gray
        if (height, width) != small.shape:
            small = np.asarray(cv2.resize(small, (width, height), interpolation=cv2.INTER_AREA), np.uint8)
        gray = np.asarray(cv2.GaussianBlur(small.astype(np.float32), (0, 0), BLUR_PX), np.float32)
        by_x, by_y = (cv2.Sobel(gray, cv2.CV_32F, *axis, ksize=3, scale=1.0 / 8.0) for axis in ((1, 0), (0, 1)))
        projection = self.projection(share)
        rays = np.asarray(np.linalg.inv(projection[:, :3]), np.float64)
        return PhotoLevel(projection, self.center, rays, np.stack([gray, by_x, by_y], axis=-1, dtype=np.float32))


@dataclass(frozen=True, slots=True, eq=False)
class PhotoLevel:
    """A photo at one resolution."""

    projection: FloatArray
    """(3, 4) K [R | t]."""
    center: FloatArray
    """(3,) in the world."""
    rays: FloatArray
    """(3, 3) from pixels (x, y, 1) to rays in the world, at depth 1."""
    image: Gray
    """(H, W, 3) gray levels, and their derivatives by x and by y, per pixel."""
