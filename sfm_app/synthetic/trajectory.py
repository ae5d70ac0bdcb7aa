"""Move a synthetic camera smoothly through time, and photograph with a shutter that reads one row after the other."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, RotationSpline

from sfm_app.errors import ConfigError
from sfm_app.synthetic.cameras import Camera, look_at

FloatArray = NDArray[np.float64]

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
