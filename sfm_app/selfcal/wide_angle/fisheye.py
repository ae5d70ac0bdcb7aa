"""Lenses of two parameters: from points of a photo to directions, also behind the camera.

Ours; the projections are the textbook's. A ray at the angle theta to the optical axis comes to lie at the radius, in
focal lengths,

    r = tan(e theta) / e  (e > 0),      theta  (e = 0),      sin(-e theta) / -e  (e < 0).

e = 1 is a perspective lens, 1/2 stereographic, 0 equidistant, -1/2 equisolid, -1 orthographic. All have the same scale
about the center, the focal length.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sfm_app.geometry.camera import camera_matrix, rays

FloatArray = NDArray[np.float64]

PERSPECTIVE, STEREOGRAPHIC, EQUIDISTANT, EQUISOLID = 1.0, 0.5, 0.0, -0.5
"""Exponents, by definition of the family."""
EQUIDISTANT_BELOW = 1e-6
"""Exponents nearer to 0 are taken as 0: the series agree to double precision."""
STEP = 1e-5
"""Step of the derivatives by finite differences, in longer sides: curvature and rounding in double precision cost about
1e-10 of them."""


@dataclass(frozen=True, slots=True)
class Fisheye:
    """A lens with one focal, in any unit of length."""

    focal: float
    exponent: float
    center: tuple[float, float] = (0.0, 0.0)

    def radius(self, theta: FloatArray) -> FloatArray:
        """Return the radius about the center of rays at angles `theta` (N,), in radians, to the optical axis."""
        e = self.exponent
        if abs(e) < EQUIDISTANT_BELOW:
            return np.asarray(self.focal * theta, np.float64)
        return np.asarray(self.focal * (np.tan(e * theta) / e if e > 0 else np.sin(-e * theta) / -e), np.float64)

    def angle(self, radius: FloatArray) -> FloatArray:
        """Return the angle to the optical axis, in radians; points beyond the image circle lie on it."""
        r, e = np.asarray(radius) / self.focal, self.exponent
        if abs(e) < EQUIDISTANT_BELOW:
            return np.asarray(np.minimum(r, np.pi), np.float64)
        angle = np.arctan(e * r) / e if e > 0 else np.arcsin(np.minimum(-e * r, 1.0)) / -e
        return np.asarray(np.minimum(angle, np.pi), np.float64)

    def rays(self, points: FloatArray) -> FloatArray:
        """Return (N, 3) directions of length 1 of points (N, 2)."""
        about = points - np.array(self.center)
        radius = np.hypot(about[:, 0], about[:, 1])
        theta = self.angle(radius)
        along = np.divide(np.sin(theta), radius, out=np.full_like(radius, 1.0 / self.focal), where=radius > 0.0)
        return np.column_stack([about * along[:, None], np.cos(theta)])

    def project(self, rays: FloatArray) -> FloatArray:
        """Return (N, 2) points of rays (N, 3) of any length."""
        side = np.hypot(rays[:, 0], rays[:, 1])
        radius = self.radius(np.arctan2(side, rays[:, 2]))
        return rays[:, :2] * np.divide(radius, side, out=np.zeros_like(side), where=side > 0.0)[:, None] + self.center

    def field_deg(self, width: float) -> float:
        """Return the angle between the rays to both ends of a width about the center, in degrees.

        Args:
            width: in the units of the focal.
        """
        return float(2.0 * np.degrees(self.angle(np.array([0.5 * width]))[0]))


@dataclass(frozen=True, slots=True)
class RadialLens:
    """A perspective lens with one radial term, as COLMAP's SIMPLE_RADIAL, in any unit of length."""

    focal: float
    radial: float
    center: tuple[float, float] = (0.0, 0.0)

    def rays(self, points: FloatArray) -> FloatArray:
        """Return (N, 3) directions of length 1 of points (N, 2)."""
        plane = rays(points, camera_matrix(self.focal, self.focal, *self.center), self.radial)
        found = np.column_stack([plane, np.ones(len(plane))])
        return np.asarray(found / np.linalg.norm(found, axis=1, keepdims=True), np.float64)


@dataclass(frozen=True, slots=True)
class WholeTurn:
    """An equirectangular photo with the origin in its middle and a width of 1; its columns are longitudes."""

    def rays(self, points: FloatArray) -> FloatArray:
        """Return (N, 3) directions of length 1 of points (N, 2)."""
        longitude, latitude = 2.0 * np.pi * np.asarray(points, np.float64).T
        level = np.cos(latitude)
        return np.column_stack([level * np.sin(longitude), np.sin(latitude), level * np.cos(longitude)])


Lens = Fisheye | RadialLens


def bearings_through(lens: Lens | WholeTurn, matches: FloatArray) -> FloatArray:
    """Return (N, 18) bearing vectors of matches, with their derivatives by x and y: view 1, view 2.

    Args:
        lens: of both photos, in longer sides.
        matches: (N, 4) x1, y1, x2, y2 in the same unit.
    """
    return np.hstack([_rays_and_slopes(lens, matches[:, :2]), _rays_and_slopes(lens, matches[:, 2:])])


def _rays_and_slopes(lens: Lens | WholeTurn, points: FloatArray) -> FloatArray:
    here, right, down = lens.rays(points), np.array([STEP, 0.0]), np.array([0.0, STEP])
    return np.hstack([here, (lens.rays(points + right) - here) / STEP, (lens.rays(points + down) - here) / STEP])
