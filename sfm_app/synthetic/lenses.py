"""Lenses of synthetic cameras: from rays to points of the photo, and back."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sfm_app.errors import ConfigError

FloatArray = NDArray[np.float64]

NEWTON_STEPS = 100
LEAST_SLOPE = 1e-3
"""Of the distorted radius, so that a step near the fold stays finite."""
FOLD_SAMPLES = 100_001
PROJECTIONS = ("perspective", "stereographic", "equidistant", "equisolid", "equirectangular")


@dataclass(frozen=True, slots=True)
class Lens:
    """How rays become points of the normalized image plane, whose unit is the focal length.

    A ray at the angle theta to the optical axis comes to lie at the radius r of its projection: tan(theta),
    2 tan(theta / 2), theta, or 2 sin(theta / 2). Then x_d = x (1 + k1 r^2 + k2 r^4 + ...), and the tangential terms of
    COLMAP's OPENCV are added. An equirectangular photo has longitude and latitude instead, and no such terms.

    Raises:
        ConfigError: the projection is unknown.
    """

    projection: str = "perspective"
    """One of `PROJECTIONS`."""
    radial: tuple[float, ...] = ()
    """k1, k2, ...: with "perspective" those of COLMAP's OPENCV, with "equidistant" of its OPENCV_FISHEYE."""
    tangential: tuple[float, float] = (0.0, 0.0)
    """p1, p2."""

    def __post_init__(self) -> None:
        if self.projection not in PROJECTIONS:
            raise ConfigError(f"synthetic lens: unknown projection {self.projection}", hint=", ".join(PROJECTIONS))

    @property
    def k1(self) -> float:
        """First radial term, 0 without one."""
        return self.radial[0] if self.radial else 0.0

    def rays(self, points: FloatArray) -> FloatArray:
        """Return (N, 3) directions, z = 1 with "perspective", else of length 1; NaN for points that no ray reaches.

        Args:
            points: (N, 2) on the normalized image plane.

        Raises:
            ConfigError: the distortion folds within these points, so that one of them has several rays.
        """
        if self.projection == "equirectangular":
            longitude, latitude = points.T
            level = np.cos(latitude)
            return np.column_stack([level * np.sin(longitude), np.sin(latitude), level * np.cos(longitude)])
        plain = self._undistort(points)
        if self.projection == "perspective":
            return np.column_stack([plain, np.ones(len(plain))])
        radius = np.hypot(*plain.T)
        theta = self._angle(radius)
        along = np.divide(np.sin(theta), radius, out=np.ones_like(radius), where=radius > 0)
        return np.column_stack([plain * along[:, None], np.cos(theta)])

    def project(self, rays: FloatArray) -> FloatArray:
        """Return (N, 2) points of the normalized image plane.

        Args:
            rays: (N, 3) of any length; in front of the camera with "perspective".
        """
        side = np.hypot(rays[:, 0], rays[:, 1])
        if self.projection == "equirectangular":
            level = np.hypot(rays[:, 0], rays[:, 2])
            return np.column_stack([np.arctan2(rays[:, 0], rays[:, 2]), np.arctan2(rays[:, 1], level)])
        radius = self._radius(np.arctan2(side, rays[:, 2]))
        plain = rays[:, :2] * np.divide(radius, side, out=np.zeros_like(side), where=side > 0)[:, None]
        return plain * self._factor(np.hypot(*plain.T))[:, None] + self._shift(plain)

    def _radius(self, theta: FloatArray) -> FloatArray:
        """Return the radius at which a ray at an angle to the optical axis comes to lie, before distortion."""
        if self.projection == "perspective":
            return np.asarray(np.tan(theta))
        if self.projection == "stereographic":
            return np.asarray(2.0 * np.tan(theta / 2.0))
        return theta if self.projection == "equidistant" else np.asarray(2.0 * np.sin(theta / 2.0))

    def _angle(self, radius: FloatArray) -> FloatArray:
        """Return the angle to the optical axis; NaN beyond the ray that looks backwards."""
        if self.projection == "stereographic":
            return np.asarray(2.0 * np.arctan(radius / 2.0))
        if self.projection == "equidistant":
            return np.where(radius <= math.pi, radius, np.nan)
        with np.errstate(invalid="ignore"):
            return np.asarray(2.0 * np.arcsin(radius / 2.0))

    def _factor(self, radius: FloatArray, slope: bool = False) -> FloatArray:
        """Return the distorted over the undistorted radius, or its derivative by the undistorted one."""
        total = np.ones_like(radius)
        for power, k in enumerate(self.radial, start=1):
            total += (2 * power + 1 if slope else 1) * k * radius ** (2 * power)
        return total

    def _shift(self, plain: FloatArray) -> FloatArray:
        """Return (N, 2) the tangential terms."""
        (p1, p2), (x, y) = self.tangential, plain.T
        square = x * x + y * y
        return np.column_stack(
            [2.0 * p1 * x * y + p2 * (square + 2.0 * x * x), p1 * (square + 2.0 * y * y) + 2.0 * p2 * x * y]
        )

    def _undistort(self, points: FloatArray) -> FloatArray:
        """Return (N, 2) the points as they would lie without the radial and tangential terms."""
        if not any(self.tangential):
            return self._undistort_radius(points)
        plain = points
        for _ in range(NEWTON_STEPS):
            before, plain = plain, self._undistort_radius(points - self._shift(plain))
            if np.max(np.abs(plain - before), initial=0.0) < 1e-14:
                break
        return plain

    def _undistort_radius(self, points: FloatArray) -> FloatArray:
        """Return (N, 2) the points as they would lie without the radial terms, on the branch through the center."""
        distorted = np.hypot(points[:, 0], points[:, 1])
        r = distorted.copy()
        if any(self.radial):
            self._check_fold(float(distorted.max(initial=0.0)))
        for _ in range(NEWTON_STEPS if any(self.radial) else 0):
            step = (r * self._factor(r) - distorted) / np.maximum(self._factor(r, slope=True), LEAST_SLOPE)
            r -= step
            if np.all(np.abs(step) <= 2.0 * np.finfo(np.float64).eps * r):
                break
        return points * np.divide(r, distorted, out=np.ones_like(r), where=distorted > 0)[:, None]

    def _check_fold(self, largest: float) -> None:
        """Check that the distorted radius grows with the undistorted one up to the largest one of the photo."""
        radius = np.linspace(0.0, 4.0 * max(largest, 1e-9), FOLD_SAMPLES)
        ends = np.flatnonzero(self._factor(radius, slope=True) <= 0.0)
        if len(ends) and (radius * self._factor(radius))[ends[0]] <= largest:
            terms = ", ".join(f"{k:g}" for k in self.radial)
            raise ConfigError(f"synthetic camera: a radial distortion of {terms} folds within the photo")
