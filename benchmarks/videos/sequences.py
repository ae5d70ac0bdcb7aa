"""Synthetic videos with a known readout: noisy keypoints of points all around, wrong ones among them, and no photos."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks.lenses.bundles import Drawn, adjust_like_mapping, write_model
from benchmarks.synthetic.walks import WalkOptions, project_through_shutter, walk
from sfm_app.camera.models import camera_matrix
from sfm_app.colmap.backend import pycolmap
from sfm_app.synthetic.cameras import Camera, Lens, Views

FloatArray = NDArray[np.float64]

SIZE = (1280, 720)
FOCAL_PX = 1000.0
FRAMES, FRAMES_PER_S = 36, 30.0
NOISE_PX = 0.4
POINTS = 2500
DEPTHS = (2.0, 12.0)
"""Range of the distance of points to one of the frames, in meters."""
SEEN_SHARE = 0.7
"""Share of the frames that show a point in which it is found."""
WRONG_SHARE, WRONG_PX = 0.05, 3.0
"""Share of keypoints that are off by more than noise, and the scale of that (Laplace)."""
LENS = Lens(radial=(-0.06, 0.02), tangential=(0.0004, -0.0003))
"""A lens that bends by 15 pixels in the corner, and that mapping starts without."""
STRONG_LENS = Lens(radial=(-0.28, 0.11, -0.02), tangential=(0.0015, 0.001))
"""An action camera's lens; it bends by 60 pixels in the corner."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Kind:
    """How a video is taken, and what is wrong with it besides its shutter."""

    walk: WalkOptions
    """Its length follows from the frames."""
    every: int = 3
    """Every such frame is used."""
    frames: int = FRAMES
    points: int = POINTS
    lens: Lens = LENS
    moving_share: float = 0.0
    """Share of the points that move by themselves, together, at 0.5 m/s."""
    center_jitter_px: float = 0.0
    """Standard deviation of the optical center from frame to frame, as of a stabilized lens."""
    breathing: float = 0.0
    """Relative change of the focal length from the first frame to the last."""


@dataclass(frozen=True, slots=True, eq=False)
class Sequence:
    """Frames of a video, before they are a model of COLMAP."""

    drawn: Drawn
    times_s: dict[str, float]
    """By photo name."""


def draw_sequence(kind: Kind, readout_s: float, seed: int) -> Sequence:
    """Draw the frames of a video.

    Args:
        kind: how it is taken.
        readout_s: of the shutter, in seconds; 0 for a global one.
        seed: same seed, same frames.
    """
    rng = np.random.default_rng([seed, 37])
    times = np.asarray(kind.every / FRAMES_PER_S * np.arange(kind.frames), np.float64)
    trajectory = walk(with_length(kind.walk, float(times[-1])), seed)
    center = np.array(SIZE) * (0.5 + rng.normal(scale=0.005, size=2))
    camera = Camera(camera_matrix(FOCAL_PX, FOCAL_PX, *center), *SIZE, kind.lens)
    poses = trajectory.poses(times)
    X = _draw_points(camera, poses, kind.points, rng)
    own = np.where((rng.random(kind.points) < kind.moving_share)[:, None], rng.normal(size=3), 0.0)
    own *= 0.5 / max(float(np.linalg.norm(own, axis=1).max()), 1e-9)
    seen, x = {}, {}
    for number, (time, pose) in enumerate(zip(times, poses, strict=True), start=1):
        points = X + time * own
        near = np.flatnonzero((points @ pose[:, :3].T + pose[:, 3])[:, 2] > 0.3)
        shown = _frame_camera(camera, kind, number, rng)
        found = project_through_shutter(shown, trajectory, float(time), readout_s, points[near])
        inside = np.all((found > 0.0) & (found < SIZE), axis=1) & (rng.random(len(near)) < SEEN_SHARE)
        seen[number], x[number] = near[inside], found[inside] + _errors(int(inside.sum()), rng)
    named = {f"frame_{kind.every * k:04d}.jpg": pose for k, pose in enumerate(poses)}
    drawn = Drawn(camera, Views(dict.fromkeys(named, camera), named), X, seen, x)
    return Sequence(drawn, dict(zip(named, map(float, times), strict=True)))


def with_length(options: WalkOptions, seconds: float) -> WalkOptions:
    """Return a walk of this length."""
    return WalkOptions(
        seconds=seconds, speed=options.speed, swing_deg_s=options.swing_deg_s, swing_period_s=options.swing_period_s,
        shake=options.shake, start=options.start, heading_deg=options.heading_deg, look_deg=options.look_deg,
    )  # fmt: skip


def _frame_camera(camera: Camera, kind: Kind, number: int, rng: np.random.Generator) -> Camera:
    """Return the camera at the time of a frame."""
    K = camera.K.copy()
    K[:2, 2] += rng.normal(scale=kind.center_jitter_px, size=2)
    K[[0, 1], [0, 1]] *= 1.0 + kind.breathing * (number - 1) / (kind.frames - 1)
    return Camera(K, camera.width, camera.height, camera.lens)


def _errors(count: int, rng: np.random.Generator) -> FloatArray:
    """Return the errors (N, 2) of keypoints."""
    wrong = rng.random(count) < WRONG_SHARE
    off = rng.normal(scale=NOISE_PX, size=(count, 2))
    off[wrong] += rng.laplace(scale=WRONG_PX, size=(int(wrong.sum()), 2))
    return off


def _draw_points(camera: Camera, poses: FloatArray, count: int, rng: np.random.Generator) -> FloatArray:
    """Return points (N, 3), each on the ray of a random pixel of a random frame."""
    pixels = rng.uniform([0.0, 0.0], SIZE, (count, 2))
    rays = camera.lens.rays((pixels - camera.K[:2, 2]) / np.diag(camera.K)[:2])
    rays /= np.linalg.norm(rays, axis=1)[:, None]
    depths = rng.uniform(*DEPTHS, (count, 1))
    chosen = poses[rng.integers(len(poses), size=count)]
    return np.asarray(np.einsum("nji,nj->ni", chosen[:, :, :3], depths * rays - chosen[:, :, 3]), np.float64)


def map_sequence(sequence: Sequence, seed: int, folder: Path) -> tuple[pycolmap.Reconstruction, Path]:
    """Return the model of a video as mapping leaves it, without a word of its shutter, and its database.

    Args:
        sequence: the frames.
        seed: of the error of the focal that mapping starts from.
        folder: where the database is written.
    """
    focal = FOCAL_PX * float(np.exp(np.random.default_rng(seed).normal(scale=0.01)))
    kind = pycolmap.CameraModelId.SIMPLE_RADIAL
    params = [focal, SIZE[0] / 2, SIZE[1] / 2, sequence.drawn.camera.radial]
    start = pycolmap.Camera(camera_id=1, model=kind, width=SIZE[0], height=SIZE[1], params=params)
    database = folder / "database.db"
    model = write_model(sequence.drawn, start, database)
    adjust_like_mapping(model, lens=True)
    model.update_point_3d_errors()
    return model, database
