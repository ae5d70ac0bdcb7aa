"""Walks past a wall, around and on one spot; smooth paths through time, and photos read row by row."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, RotationSpline

from sfm_app.errors import ConfigError
from sfm_app.synthetic.cameras import Camera, Views, look_at, stratified_samples

FloatArray = NDArray[np.float64]


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
        [x, stratified_samples(options.height, count, rng), stratified_samples(options.distance, count, rng)]
    )
    # parallel axes would leave the focal length undetermined
    aims = np.column_stack(
        [x * stratified_samples((0.2, 0.9), count, rng), stratified_samples(options.aim, count, rng), np.zeros(count)]
    )
    roll_deg = stratified_samples((-options.roll_deg, options.roll_deg), count, rng)
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


KNOTS_PER_S = 100.0
"""Knots of the splines: ten times the highest frequency of a hand."""
MARGIN_S = 0.2
"""Time before the first and after the last frame that a trajectory covers, so that their rows lie on it."""
ROW_ITERATIONS = 8
"""A point's row depends on the pose, and the pose on the row; each iteration removes nine tenths of the error."""
BEHIND = 0.05
"""Least depth of a point that is projected, in scene units."""


@dataclass(frozen=True, slots=True, eq=False)
class Trajectory:
    """The pose of a camera at any time."""

    centers: CubicSpline
    """Camera center (3,) over seconds, in scene units."""
    rotations: RotationSpline
    """World from camera, over seconds."""

    def poses(self, times_s: FloatArray) -> FloatArray:
        """Return cam_from_world (N, 3, 4) at some times (N,) in seconds."""
        R = self.rotations(times_s).inv().as_matrix()
        return np.concatenate([R, -np.einsum("nij,nj->ni", R, self.centers(times_s))[:, :, None]], axis=2)


@dataclass(frozen=True, slots=True, kw_only=True)
class WalkOptions:
    """A walk straight on with a camera in the hand, which swings from side to side, bobs and shakes.

    Raises:
        ConfigError: a value is out of range.
    """

    seconds: float = 4.0
    """From the first to the last frame, > 0."""
    speed: float = 1.4
    """In scene units per second, >= 0; with meters, that of a walker."""
    swing_deg_s: float = 0.0
    """Fastest turn about the vertical axis, in degrees per second, >= 0."""
    swing_period_s: float = 4.0
    """From one side to the other and back, > 0."""
    shake: float = 1.0
    """Bobbing and shaking as a share of a walker's, >= 0."""
    start: tuple[float, float, float] = (0.0, 1.5, 0.0)
    """Where the walk begins, in scene units."""
    heading_deg: float = 90.0
    """Direction of the walk about the vertical axis: 0 towards -z, 90 towards +x."""
    look_deg: float = 0.0
    """Middle viewing direction, counted in the same way."""

    def __post_init__(self) -> None:
        checks = {
            "seconds": 0 < self.seconds < math.inf,
            "speed": 0 <= self.speed < math.inf,
            "swing_deg_s": 0 <= self.swing_deg_s < math.inf,
            "swing_period_s": 0 < self.swing_period_s < math.inf,
            "shake": 0 <= self.shake < math.inf,
        }
        wrong = [name for name, holds in checks.items() if not holds]
        if wrong:
            raise ConfigError(f"synthetic trajectory: out of range: {', '.join(wrong)}")


def walk(options: WalkOptions, seed: int = 0) -> Trajectory:
    """Return the trajectory of a walk; its first frame is at 0 s.

    A step lifts the body by 2.5 cm twice a second, sways it by 2 cm once a second, and turns the camera by up to a
    degree. A slow drift of the hand comes on top.

    Args:
        options: the walk.
        seed: same seed, same phases of all movements.
    """
    rng = np.random.default_rng([seed, 17])
    span = options.seconds + 2.0 * MARGIN_S
    times = np.linspace(-MARGIN_S, options.seconds + MARGIN_S, math.ceil(span * KNOTS_PER_S) + 1)
    step_hz = rng.uniform(1.8, 2.1)

    def swing(amplitude: float, hz: float) -> FloatArray:
        return np.asarray(options.shake * amplitude * np.sin(2.0 * np.pi * (hz * times + rng.random())))

    heading = math.radians(options.heading_deg)
    ahead, aside = (np.array([math.sin(a), 0.0, -math.cos(a)]) for a in (heading, heading + 0.5 * math.pi))
    sideways = swing(0.02, step_hz / 2.0) + swing(0.03, 0.31)
    upward = swing(0.025, step_hz) + swing(0.02, 0.23)
    centers = np.array(options.start) + np.outer(options.speed * times, ahead) + np.outer(sideways, aside)
    centers[:, 1] += upward
    hz = 1.0 / options.swing_period_s
    turn_deg = options.swing_deg_s / (2.0 * np.pi * hz) * np.sin(2.0 * np.pi * (hz * times + rng.random()))
    yaw = np.radians(options.look_deg + turn_deg + swing(0.8, step_hz / 2.0) + swing(1.5, 0.37))
    pitch = np.radians(swing(0.6, step_hz) + swing(2.0, 0.29))
    roll_deg = swing(1.0, step_hz / 2.0) + swing(1.5, 0.33)
    ways = np.column_stack([np.sin(yaw) * np.cos(pitch), np.sin(pitch), -np.cos(yaw) * np.cos(pitch)])
    poses = [look_at(c, c + way, roll) for c, way, roll in zip(centers, ways, roll_deg, strict=True)]
    rotations = Rotation.from_matrix(np.array(poses)[:, :, :3]).inv()
    return Trajectory(CubicSpline(times, centers), RotationSpline(times, rotations))


def row_poses(trajectory: Trajectory, time_s: float, readout_s: float, rows: int) -> FloatArray:
    """Return the pose (rows, 3, 4) that each row of a frame is seen from; the middle of the frame is seen at its time.

    Args:
        trajectory: motion of the camera.
        time_s: of the frame, in seconds.
        readout_s: time from the upper edge of the frame to the lower one, in seconds; negative from below.
        rows: of the frame.
    """
    return trajectory.poses(time_s + readout_s * ((np.arange(rows) + 0.5) / rows - 0.5))


def project_through_shutter(
    camera: Camera, trajectory: Trajectory, time_s: float, readout_s: float, points: FloatArray
) -> FloatArray:
    """Project points into a frame, each from the pose at the time of its own row.

    Args:
        camera: intrinsics and lens.
        trajectory: motion of the camera.
        time_s, readout_s: as in `row_poses`.
        points: (N, 3) in the world.

    Returns:
        (N, 2) pixels, also outside of the frame; NaN for points behind the camera.
    """
    found = np.full((len(points), 2), np.nan)
    row = np.full(len(points), 0.5 * camera.height)
    for _ in range(ROW_ITERATIONS):
        # beyond the frame there are no rows, and no time
        share = np.clip(row / camera.height, 0.0, 1.0) - 0.5
        poses = trajectory.poses(time_s + readout_s * share)
        seen = np.einsum("nij,nj->ni", poses[:, :, :3], points) + poses[:, :, 3]
        ahead = seen[:, 2] > BEHIND
        found[~ahead] = np.nan
        found[ahead] = camera.lens.project(seen[ahead]) * np.diag(camera.K)[:2] + camera.K[:2, 2]
        row = np.where(ahead, found[:, 1], 0.5 * camera.height)
    return found
