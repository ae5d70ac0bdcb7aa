"""Cameras with any lens, their poses along a photographer's path, and the rays of their pixels.

ConfigError for values out of range, and for a distortion that folds within the photo.
"""

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from sfm_app.camera.models import camera_matrix
from sfm_app.camera.projection import (
    OPTIONS,
    RAY,
    Fisheye,
    fold_radius,
    image_points,
    image_rays,
    lens_terms,
    radius_at,
)
from sfm_app.camera.rows import FISHEYE, PANORAMA, PERSPECTIVE
from sfm_app.errors import ConfigError
from sfm_app.types.arrays import FloatArray

CURVES = {"stereographic": 0.5, "equisolid": -0.5}
"""Projections that are none of COLMAP's, and their exponents in `Fisheye`."""
PROJECTIONS = ("perspective", "stereographic", "equidistant", "equisolid", "equirectangular")


@dataclass(frozen=True, slots=True)
class Lens:
    """Projection and distortion, to the normalized image plane whose unit is the focal length.

    A ray at the angle theta to the optical axis has the radius r = tan(theta), 2 tan(theta / 2), theta, or
    2 sin(theta / 2), by projection. Then x_d = x (1 + k1 r^2 + k2 r^4 + ...), plus the tangential terms of COLMAP's
    OPENCV. An equirectangular photo has longitude and latitude instead, and no such terms.
    """

    projection: str = "perspective"
    """One of `PROJECTIONS`."""
    radial: tuple[float, ...] = ()
    """k1, k2, ...: of "equidistant" at most the four of COLMAP's OPENCV_FISHEYE, else three as of its FULL_OPENCV."""
    tangential: tuple[float, float] = (0.0, 0.0)
    """p1, p2."""

    def __post_init__(self) -> None:
        if self.projection not in PROJECTIONS:
            raise ConfigError(f"synthetic lens: unknown projection {self.projection}", hint=", ".join(PROJECTIONS))
        if len(self.radial) > (most := 4 if self.projection == "equidistant" else 3):
            raise ConfigError(f"synthetic lens: {self.projection} has at most {most} radial terms")

    def rays(self, points: FloatArray) -> FloatArray:
        """Return directions (N, 3) of image points (N, 2), z = 1 with "perspective", else of length 1; NaN without."""
        family, params = self._family, self._params
        rays = image_rays(points, params, family)[:, RAY]
        if family == PANORAMA:
            return rays
        fold = fold_radius(lens_terms(params), family, 0.0)
        last = np.array([fold if family == FISHEYE else np.arctan(fold)])
        hidden = np.hypot(*points.T) > radius_at(last, params, family)
        if hidden.any() and fold < (np.pi if family == FISHEYE else OPTIONS.most_radius):
            terms = ", ".join(f"{k:g}" for k in self.radial)
            raise ConfigError(f"synthetic camera: a radial distortion of {terms} folds within the photo")
        if self.projection in CURVES:
            curve, plane = Fisheye(1.0, CURVES[self.projection]), rays[:, :2]
            hidden = np.hypot(*plane.T) > curve.radius(np.array([np.pi]))
            rays = curve.rays(plane)
        return np.where(hidden[:, None], np.nan, rays)

    def project(self, rays: FloatArray) -> FloatArray:
        """Return image points (N, 2) of rays (N, 3) of any length; with "perspective", in front of the camera."""
        if self.projection in CURVES:
            plane = Fisheye(1.0, CURVES[self.projection]).project(rays)
            rays = np.column_stack([plane, np.ones(len(plane))])
        return image_points(rays, self._params, self._family)

    @property
    def _family(self) -> int:
        """Family of the camera; of a lens in `CURVES`, that of its distortion."""
        return {"equidistant": FISHEYE, "equirectangular": PANORAMA}.get(self.projection, PERSPECTIVE)

    @property
    def _params(self) -> FloatArray:
        """(12,) of a camera with the focal length 1."""
        k1, k2, k3, k4 = (*self.radial, 0.0, 0.0, 0.0, 0.0)[:4]
        return np.array([1.0, 1.0, 0.0, 0.0, k1, k2, *self.tangential, k3, k4, 0.0, 0.0])


@dataclass(frozen=True, slots=True, eq=False)
class Camera:
    """Intrinsics and image size, shared by photos of one camera."""

    K: FloatArray
    """(3, 3) camera matrix in pixels, zero skew."""
    width: int
    height: int
    lens: Lens = Lens()
    """Projection and distortion, on the plane whose unit is the focal length."""

    @property
    def radial(self) -> float:
        """k1 of COLMAP's SIMPLE_RADIAL and OPENCV: x_d = x_u (1 + k1 r^2) about the optical center; < 0: barrel."""
        return self.lens.radial[0] if self.lens.radial else 0.0


@dataclass(frozen=True, slots=True, eq=False)
class Views:
    """Photos to render: the camera and pose of each."""

    cameras: Mapping[str, Camera]
    """By photo name; same names as in `cam_from_world`."""
    cam_from_world: Mapping[str, FloatArray]
    """By photo name: (3, 4) [R | t]."""
    row_poses: Mapping[str, FloatArray] = field(default_factory=dict)
    """By photo name with a rolling shutter: (height, 3, 4) pose of each row."""

    @classmethod
    def from_poses(cls, camera: Camera, poses: Sequence[FloatArray]) -> "Views":
        """Return photos of one camera at poses cam_from_world (3, 4), named view_00.jpg and so on."""
        named = {f"view_{k:02d}.jpg": pose for k, pose in enumerate(poses)}
        return cls(dict.fromkeys(named, camera), named)

    def with_camera(self, camera: Camera, photos: Collection[str]) -> "Views":
        """Return the views with another camera for some photos."""
        if unknown := sorted(set(photos) - set(self.cameras)):
            raise ConfigError(f"synthetic cameras: no such photo: {', '.join(unknown)}")
        return replace(self, cameras={**self.cameras, **dict.fromkeys(sorted(photos), camera)})


@dataclass(frozen=True, slots=True, kw_only=True)
class ArcOptions:
    """A hand-held walk around the front of a scene: distance, height, aim and roll vary from photo to photo."""

    photos: int = 12
    """>= 2."""
    sweep_deg: float = 80.0
    """Angle of the arc, in degrees, (0, 360]."""
    distance: tuple[float, float] = (4.6, 6.6)
    """Range of the distance to the middle, in scene units, > 0."""
    height: tuple[float, float] = (0.7, 2.6)
    """Range of the height above the ground, in scene units."""
    aim: tuple[float, float, float] = (0.0, 1.3, -0.2)
    """Point that the photos look at, before random offsets."""
    aim_spread: float = 0.4
    """Largest offset of the aim in each direction, in scene units, >= 0."""
    roll_deg: float = 14.0
    """Largest roll either way, in degrees, [0, 180]."""

    def __post_init__(self) -> None:
        check_ranges(
            "synthetic cameras",
            photos=self.photos >= 2,
            sweep_deg=0 < self.sweep_deg <= 360,
            distance=0 < self.distance[0] <= self.distance[1] < math.inf,
            height=self.height[0] <= self.height[1],
            aim_spread=0 <= self.aim_spread < math.inf,
            roll_deg=0 <= self.roll_deg <= 180,
        )


def check_ranges(subject: str, **valid: bool) -> None:
    """Raise a ConfigError that names all values out of range."""
    if wrong := [name for name, holds in valid.items() if not holds]:
        raise ConfigError(f"{subject}: out of range: {', '.join(wrong)}")


def make_camera(
    width: int, height: int, focal_widths: float = 1.05, center: tuple[float, float] = (0.53, 0.48),
    aspect: float = 1.0, radial: float = 0.0,
) -> Camera:  # fmt: skip
    """Return a camera with an optical center off the middle of the image, so that a default guess is wrong.

    Args:
        width, height: pixels, >= 16.
        focal_widths: fx as a share of the width, > 0.
        center: optical center as shares of width and height.
        aspect, radial: fy / fx, > 0; k1 of a perspective lens.
    """
    if min(width, height) < 16 or not (0 < focal_widths < math.inf and 0 < aspect < math.inf):
        raise ConfigError("synthetic camera: size, focal_widths or aspect is out of range")
    fx = focal_widths * width
    K = camera_matrix(fx, fx * aspect, center[0] * width, center[1] * height)
    return Camera(K, width, height, Lens(radial=(radial,) if radial else ()))


def make_wide_camera(
    width: int, height: int, field_deg: float, lens: Lens, center: tuple[float, float] = (0.51, 0.495)
) -> Camera:
    """Return a camera with a given field of view along the longer side, measured from the middle of the photo.

    The field is below 360 degrees, and below 180 with "perspective". `center` has shares of width and height.
    """
    limit = 180.0 if lens.projection == "perspective" else 360.0
    if min(width, height) < 16 or not 0 < field_deg < limit:
        raise ConfigError("synthetic camera: size or field_deg is out of range")
    half = math.radians(field_deg / 2.0)
    reach = float(lens.project(np.array([[math.sin(half), 0.0, math.cos(half)]]))[0, 0])
    focal = 0.5 * max(width, height) / reach
    return Camera(camera_matrix(focal, focal, center[0] * width, center[1] * height), width, height, lens)


def panorama_camera(width: int) -> Camera:
    """Return the camera of an equirectangular photo of this width >= 32 pixels, twice as wide as high."""
    focal = width / (2.0 * math.pi)
    K = camera_matrix(focal, focal, width / 2, width / 4)
    return Camera(K, width, width // 2, Lens("equirectangular"))


def arc(camera: Camera, options: ArcOptions | None = None, seed: int = 0) -> Views:
    """Return hand-held photos along an arc in front of the scene (towards +z, y up), named view_00.jpg and so on."""
    options = options or ArcOptions()
    rng = np.random.default_rng([seed, 11])
    count = options.photos
    # stratified, so that few photos already spread over the whole range
    azimuth = np.radians(options.sweep_deg) * (np.arange(count) / (count - 1) - 0.5)
    distance = stratified_samples(options.distance, count, rng)
    height = stratified_samples(options.height, count, rng)
    roll_deg = stratified_samples((-options.roll_deg, options.roll_deg), count, rng)
    aims = np.array(options.aim) + rng.uniform(-1.0, 1.0, (count, 3)) * options.aim_spread
    centers = np.column_stack([distance * np.sin(azimuth), height, distance * np.cos(azimuth)])
    poses = [look_at(center, aim, roll) for center, aim, roll in zip(centers, aims, roll_deg, strict=True)]
    return Views.from_poses(camera, poses)


def look_at(center: FloatArray, aim: FloatArray, roll_deg: float = 0.0) -> FloatArray:
    """Return (3, 4) cam_from_world of a camera that looks at a point, y up; ValueError for straight up or down."""
    forward = _unit(np.asarray(aim, dtype=np.float64) - center)
    right = np.cross(forward, [0.0, 1.0, 0.0])
    if np.linalg.norm(right) < 1e-9:
        raise ValueError("a camera that looks straight up or down has no roll")
    right = _unit(right)
    R = axis_rotation(np.array([0.0, 0.0, 1.0]), roll_deg) @ np.stack([right, np.cross(forward, right), forward])
    return np.column_stack([R, -R @ center])


def axis_rotation(axis: FloatArray, angle_deg: float) -> FloatArray:
    """Return (3, 3) rotation about a unit vector (3,), right-handed (Rodrigues)."""
    x, y, z = axis
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    angle = math.radians(angle_deg)
    return np.asarray(np.eye(3) + math.sin(angle) * cross + (1.0 - math.cos(angle)) * cross @ cross)


def pixel_rays(camera: Camera, offset_px: tuple[float, float] = (0.5, 0.5)) -> FloatArray:
    """Return viewing directions (height * width, 3) in the camera frame, row by row; NaN outside the image circle.

    They have z = 1 with a perspective lens, else length 1. An offset of (0.5, 0.5) is the center of a pixel.
    """
    x, y = np.meshgrid(np.arange(camera.width) + offset_px[0], np.arange(camera.height) + offset_px[1])
    x = (x.ravel() - camera.K[0, 2]) / camera.K[0, 0]
    y = (y.ravel() - camera.K[1, 2]) / camera.K[1, 1]
    return camera.lens.rays(np.column_stack([x, y]))


def stratified_samples(limits: tuple[float, float], count: int, rng: np.random.Generator) -> FloatArray:
    """Return (count,) values in random order, one from each equal part of the range."""
    steps = (rng.permutation(count) + rng.uniform(0.2, 0.8, count)) / count
    return np.asarray(limits[0] + (limits[1] - limits[0]) * steps)


def _unit(v: FloatArray) -> FloatArray:
    return np.asarray(v / np.linalg.norm(v))
