"""Synthetic videos with a known readout: noisy keypoints of points all around, wrong ones among them, and no photos."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from benchmarks.lenses.bundles import Drawn
from sfm_app.geometry.camera import camera_matrix
from sfm_app.synthetic.cameras import Camera, Views
from sfm_app.synthetic.lenses import Lens
from sfm_app.synthetic.trajectory import Trajectory, WalkOptions, project_through_shutter, walk

FloatArray = NDArray[np.float64]

SIZE = (1280, 720)
FOCAL_PX = 1000.0
FRAMES, INTERVAL_S = 36, 0.1
"""Frames and the time between them: every third of a video of 30 frames per second."""
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


@dataclass(frozen=True, slots=True, eq=False)
class Sequence:
    """Frames of a video, before they are a model of COLMAP."""

    drawn: Drawn
    times_s: dict[str, float]
    """By photo name."""
    trajectory: Trajectory


def draw_sequence(options: WalkOptions, readout_s: float, seed: int, lens: Lens = LENS) -> Sequence:
    """Draw the frames of a walk.

    Args:
        options: the walk; its length follows from the frames.
        readout_s: of the shutter, in seconds; 0 for a global one.
        seed: same seed, same frames.
        lens: of the camera.
    """
    rng = np.random.default_rng([seed, 37])
    trajectory = walk(options, seed)
    center = np.array(SIZE) * (0.5 + rng.normal(scale=0.005, size=2))
    camera = Camera(camera_matrix(FOCAL_PX, FOCAL_PX, *center), *SIZE, lens)
    times = INTERVAL_S * np.arange(FRAMES)
    poses = trajectory.poses(np.asarray(times, np.float64))
    X = _draw_points(camera, poses, rng)
    seen, x = {}, {}
    for number, (time, pose) in enumerate(zip(times, poses, strict=True), start=1):
        near = np.flatnonzero((X @ pose[:, :3].T + pose[:, 3])[:, 2] > 0.3)
        found = project_through_shutter(camera, trajectory, float(time), readout_s, X[near])
        inside = np.all((found > 0.0) & (found < SIZE), axis=1) & (rng.random(len(near)) < SEEN_SHARE)
        wrong = rng.random(inside.sum()) < WRONG_SHARE
        off = rng.normal(scale=NOISE_PX, size=(inside.sum(), 2))
        off[wrong] += rng.laplace(scale=WRONG_PX, size=(wrong.sum(), 2))
        seen[number], x[number] = near[inside], found[inside] + off
    named = {f"frame_{k:04d}.jpg": pose for k, pose in enumerate(poses)}
    views = Views(dict.fromkeys(named, camera), named)
    return Sequence(Drawn(camera, views, X, seen, x), dict(zip(named, map(float, times), strict=True)), trajectory)


def _draw_points(camera: Camera, poses: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Return points (P, 3), each on the ray of a random pixel of a random frame."""
    pixels = rng.uniform([0.0, 0.0], SIZE, (POINTS, 2))
    rays = camera.lens.rays((pixels - camera.K[:2, 2]) / np.diag(camera.K)[:2])
    rays /= np.linalg.norm(rays, axis=1)[:, None]
    depths = rng.uniform(*DEPTHS, (POINTS, 1))
    chosen = poses[rng.integers(len(poses), size=POINTS)]
    return np.asarray(np.einsum("nji,nj->ni", chosen[:, :, :3], depths * rays - chosen[:, :, 3]), np.float64)
