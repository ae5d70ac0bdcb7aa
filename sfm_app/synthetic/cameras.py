"""Build synthetic cameras and their poses along typical photographers' paths."""

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from sfm_app.errors import ConfigError
from sfm_app.geometry.camera import camera_matrix
from sfm_app.synthetic.lenses import Lens

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class Camera:
    """Intrinsics and image size, shared by photos of one camera."""

    K: FloatArray
    """(3, 3) camera matrix in pixels, zero skew."""
    width: int
    height: int
    lens: Lens = Lens()  # noqa: RUF009 -- frozen
    """Projection and distortion, on the plane whose unit is the focal length."""

    @property
    def radial(self) -> float:
        """k1 of COLMAP's SIMPLE_RADIAL and OPENCV: x_d = x_u (1 + k1 r^2) about the optical center; < 0: barrel."""
        return self.lens.k1


@dataclass(frozen=True, slots=True, eq=False)
class Views:
    """Photos to render: the camera and pose of each."""

    cameras: Mapping[str, Camera]
    """By photo name; same names as in `cam_from_world`."""
    cam_from_world: Mapping[str, FloatArray]
    """By photo name: (3, 4) [R | t]."""
    row_poses: Mapping[str, FloatArray] = field(default_factory=dict)
    """By photo name, where a rolling shutter took it: (height, 3, 4) pose that each row is seen from."""

    @classmethod
    def from_poses(cls, camera: Camera, poses: Sequence[FloatArray]) -> "Views":
        """Return photos of one camera at several poses, named view_00.jpg and so on.

        Args:
            camera: of all photos.
            poses: (3, 4) cam_from_world each.
        """
        named = {f"view_{k:02d}.jpg": pose for k, pose in enumerate(poses)}
        return cls(dict.fromkeys(named, camera), named)

    def with_camera(self, camera: Camera, photos: Collection[str]) -> "Views":
        """Return the views with another camera for some photos.

        Args:
            camera: the other camera.
            photos: names of photos among the views.

        Raises:
            ConfigError: a photo is not among the views.
        """
        strangers = sorted(set(photos) - set(self.cameras))
        if strangers:
            raise ConfigError(f"synthetic cameras: no such photo: {', '.join(strangers)}")
        return replace(self, cameras={**self.cameras, **dict.fromkeys(sorted(photos), camera)})


@dataclass(frozen=True, slots=True, kw_only=True)
class ArcOptions:
    """A hand-held walk around the front of a scene: distance, height, aim and roll vary from photo to photo.

    They vary because a circle around a point that all photos look at (an orbit) leaves the focal length undetermined.

    Raises:
        ConfigError: a value is out of range.
    """

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
        checks = {
            "photos": self.photos >= 2,
            "sweep_deg": 0 < self.sweep_deg <= 360,
            "distance": 0 < self.distance[0] <= self.distance[1] < math.inf,
            "height": self.height[0] <= self.height[1],
            "aim_spread": 0 <= self.aim_spread < math.inf,
            "roll_deg": 0 <= self.roll_deg <= 180,
        }
        wrong = [name for name, holds in checks.items() if not holds]
        if wrong:
            raise ConfigError(f"synthetic cameras: out of range: {', '.join(wrong)}")


def make_camera(
    width: int,
    height: int,
    focal_widths: float = 1.05,
    center: tuple[float, float] = (0.53, 0.48),
    aspect: float = 1.0,
    radial: float = 0.0,
) -> Camera:
    """Return a camera whose optical center is not the image center, so that a default guess is wrong.

    Args:
        width, height: pixels, >= 16.
        focal_widths: fx as a share of the width, > 0.
        center: optical center as shares of width and height.
        aspect, radial: fy / fx, > 0; k1 of a perspective lens.

    Raises:
        ConfigError: a value is out of range.
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

    Args:
        width, height: pixels, >= 16.
        field_deg: from one end of the longer side to the other, in degrees, (0, 360); below 180 with "perspective".
        lens: projection and distortion.
        center: optical center as shares of width and height.

    Raises:
        ConfigError: a value is out of range.
    """
    limit = 180.0 if lens.projection == "perspective" else 360.0
    if min(width, height) < 16 or not 0 < field_deg < limit:
        raise ConfigError("synthetic camera: size or field_deg is out of range")
    half = math.radians(field_deg / 2.0)
    reach = float(lens.project(np.array([[math.sin(half), 0.0, math.cos(half)]]))[0, 0])
    focal = 0.5 * max(width, height) / reach
    return Camera(camera_matrix(focal, focal, center[0] * width, center[1] * height), width, height, lens)


def panorama_camera(width: int) -> Camera:
    """Return the camera of an equirectangular photo: all round, twice as wide as high.

    Args:
        width: pixels, >= 32.
    """
    focal = width / (2.0 * math.pi)
    K = camera_matrix(focal, focal, width / 2, width / 4)
    return Camera(K, width, width // 2, Lens("equirectangular"))


def arc(camera: Camera, options: ArcOptions | None = None, seed: int = 0) -> Views:
    """Return hand-held photos along an arc in front of the scene (towards +z, y up), named view_00.jpg and so on.

    Args:
        camera: of all photos.
        options: the walk; the default one if None.
        seed: same seed, same poses.
    """
    options = options or ArcOptions()
    rng = np.random.default_rng([seed, 11])
    count = options.photos
    # stratified, so that few photos already spread over the whole range
    azimuth = np.radians(options.sweep_deg) * (np.arange(count) / (count - 1) - 0.5)
    distance = _stratified_samples(options.distance, count, rng)
    height = _stratified_samples(options.height, count, rng)
    roll_deg = _stratified_samples((-options.roll_deg, options.roll_deg), count, rng)
    aims = np.array(options.aim) + rng.uniform(-1.0, 1.0, (count, 3)) * options.aim_spread
    centers = np.column_stack([distance * np.sin(azimuth), height, distance * np.cos(azimuth)])
    poses = [look_at(center, aim, roll) for center, aim, roll in zip(centers, aims, roll_deg, strict=True)]
    return Views.from_poses(camera, poses)


@dataclass(frozen=True, slots=True, kw_only=True)
class WallWalkOptions:
    """A hand-held walk along a wall that faces +z, each photo turned towards the middle by a random amount.

    Raises:
        ConfigError: a value is out of range.
    """

    photos: int = 12
    """>= 2."""
    length: float = 8.0
    """Length of the walk along x, in scene units, > 0."""
    distance: tuple[float, float] = (5.0, 7.0)
    """Range of z, in scene units."""
    height: tuple[float, float] = (1.2, 2.2)
    """Range of y, in scene units."""
    aim: tuple[float, float] = (2.0, 3.2)
    """Range of the height on the wall that the photos look at, in scene units."""
    roll_deg: float = 5.0
    """Largest roll either way, in degrees, [0, 180]."""

    def __post_init__(self) -> None:
        if self.photos < 2 or not (0 < self.length < math.inf and 0 <= self.roll_deg <= 180):
            raise ConfigError("synthetic cameras: photos, length or roll_deg is out of range")


def wall_walk(camera: Camera, options: WallWalkOptions | None = None, seed: int = 0) -> Views:
    """Return hand-held photos along a wall in the plane z = 0, from left to right, named view_00.jpg and so on.

    Args:
        camera: of all photos.
        options: the walk; the default one if None.
        seed: same seed, same poses.
    """
    options = options or WallWalkOptions()
    rng = np.random.default_rng([seed, 13])
    count = options.photos
    x = options.length * (np.arange(count) / (count - 1) - 0.5)
    centers = np.column_stack(
        [x, _stratified_samples(options.height, count, rng), _stratified_samples(options.distance, count, rng)]
    )
    # parallel axes would leave the focal length undetermined
    aims = np.column_stack(
        [x * _stratified_samples((0.2, 0.9), count, rng), _stratified_samples(options.aim, count, rng), np.zeros(count)]
    )
    roll_deg = _stratified_samples((-options.roll_deg, options.roll_deg), count, rng)
    return Views.from_poses(camera, [look_at(c, a, roll) for c, a, roll in zip(centers, aims, roll_deg, strict=True)])


def orbit(
    camera: Camera,
    photos: int = 12,
    sweep_deg: float = 80.0,
    distance: float = 5.6,
    aim: tuple[float, float, float] = (0.0, 1.3, -0.2),
) -> Views:
    """Place upright photos evenly on a level circle, all looking at its center; the focal length is undetermined.

    Any two of the optical axes meet at the same distance from both cameras (isosceles), and then F does not
    constrain the focal length (Sturm 2001); K is the same for all photos.

    Args:
        camera: takes all photos.
        photos: >= 2.
        sweep_deg: angle of the arc that the photos divide evenly, in degrees, (0, 360].
        distance: radius of the circle, in scene units, > 0.
        aim: the circle's center.

    Raises:
        ConfigError: a value is out of range.
    """
    if photos < 2 or not (0 < sweep_deg <= 360 and 0 < distance < math.inf):
        raise ConfigError("synthetic orbit: photos, sweep_deg or distance is out of range")
    # steps of sweep / photos, so that at 360 degrees the last photo does not repeat the first
    azimuth = np.radians(sweep_deg) * ((np.arange(photos) + 0.5) / photos - 0.5)
    around = np.column_stack([np.sin(azimuth), np.zeros(photos), np.cos(azimuth)])
    middle = np.array(aim)
    return Views.from_poses(camera, [look_at(middle + distance * way, middle) for way in around])


def panorama(
    camera: Camera, photos: int = 6, step_deg: float = 12.0, center: tuple[float, float, float] = (0.0, 1.5, 4.5)
) -> Views:
    """Return photos from one spot, panning left to right with slight tilt and roll: they have no parallax.

    Args:
        camera: takes all photos.
        photos: >= 2.
        step_deg: angle from photo to photo, in degrees.
        center: the spot, in scene units; the middle photo looks towards -z.
    """
    azimuth = np.radians(step_deg) * (np.arange(photos) - (photos - 1) / 2)
    tilt, roll_deg = 0.05 * np.cos(np.pi * np.arange(photos)), 3.0 * np.sin(2.0 * np.arange(photos))
    spot, ways = np.array(center), np.column_stack([np.sin(azimuth), tilt, -np.cos(azimuth)])
    return Views.from_poses(camera, [look_at(spot, spot + way, roll) for way, roll in zip(ways, roll_deg, strict=True)])


def look_at(center: FloatArray, aim: FloatArray, roll_deg: float = 0.0) -> FloatArray:
    """Return (3, 4) cam_from_world of a camera that looks at a point, world y up.

    Args:
        center: (3,) where the camera stands.
        aim: (3,) what it looks at.
        roll_deg: degrees about its optical axis.

    Raises:
        ValueError: the camera looks straight up or down, so that its roll is undefined.
    """
    forward = _unit(np.asarray(aim, dtype=np.float64) - center)
    right = np.cross(forward, [0.0, 1.0, 0.0])
    if np.linalg.norm(right) < 1e-9:
        raise ValueError("a camera that looks straight up or down has no roll")
    right = _unit(right)
    R = axis_rotation(np.array([0.0, 0.0, 1.0]), roll_deg) @ np.stack([right, np.cross(forward, right), forward])
    return np.column_stack([R, -R @ center])


def camera_center(cam_from_world: FloatArray) -> FloatArray:
    """Return (3,) position in the world of a camera with the (3, 4) pose [R | t]."""
    return np.asarray(-cam_from_world[:, :3].T @ cam_from_world[:, 3])


def axis_rotation(axis: FloatArray, angle_deg: float) -> FloatArray:
    """Return (3, 3) rotation about an axis, right-handed (Rodrigues).

    Args:
        axis: (3,) unit vector.
        angle_deg: degrees.
    """
    x, y, z = axis
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    angle = math.radians(angle_deg)
    return np.asarray(np.eye(3) + math.sin(angle) * cross + (1.0 - math.cos(angle)) * cross @ cross)


def pixel_rays(camera: Camera, offset_px: tuple[float, float] = (0.5, 0.5)) -> FloatArray:
    """Return viewing directions in the camera frame, row by row.

    Args:
        camera: its lens is undone exactly.
        offset_px: position of the ray in each pixel; (0.5, 0.5) is the center.

    Returns:
        (height * width, 3), z = 1 with a perspective lens, else of length 1; NaN where the lens shows nothing.

    Raises:
        ConfigError: the radial distortion folds within the photo, so that a pixel has no unique ray.
    """
    x, y = np.meshgrid(np.arange(camera.width) + offset_px[0], np.arange(camera.height) + offset_px[1])
    x = (x.ravel() - camera.K[0, 2]) / camera.K[0, 0]
    y = (y.ravel() - camera.K[1, 2]) / camera.K[1, 1]
    return camera.lens.rays(np.column_stack([x, y]))


def _stratified_samples(limits: tuple[float, float], count: int, rng: np.random.Generator) -> FloatArray:
    steps = (rng.permutation(count) + rng.uniform(0.2, 0.8, count)) / count
    return np.asarray(limits[0] + (limits[1] - limits[0]) * steps)


def _unit(v: FloatArray) -> FloatArray:
    return np.asarray(v / np.linalg.norm(v))
