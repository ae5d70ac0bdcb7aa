from dataclasses import dataclass

import numpy as np
import pytest

from benchmarks.synthetic.walks import Trajectory, WalkOptions, project_through_shutter, walk
from sfm_app.bundle.normal_equations import Bundle
from sfm_app.bundle.rolling_shutter import Rows
from sfm_app.camera.projection import CAMERA, PERSPECTIVE
from sfm_app.synthetic.cameras import Camera, make_camera

INTERVAL_S, POINTS, DEPTHS, NOISE_PX = 0.1, 500, (2.0, 8.0), 0.3


@dataclass(frozen=True)
class Film:
    """Frames of a walk as a bundle with true poses, points and camera."""

    bundle: Bundle
    rows: Rows
    camera: Camera
    path: Trajectory


@pytest.fixture(scope="session")
def film():
    """Makes the frames of a walk, with a shutter of some readout in seconds."""

    def shoot(readout_s, *, frames=14, seed=0, **how):
        rng = np.random.default_rng([seed, 5])
        camera, times = make_camera(1280, 720, focal_widths=0.8, center=(0.5, 0.5)), INTERVAL_S * np.arange(frames)
        path = walk(WalkOptions(seconds=float(times[-1]), **how), seed)
        poses = path.poses(times)
        depths = rng.uniform(*DEPTHS, (POINTS, 1))
        rays = np.column_stack([rng.uniform([0, 0], [1280, 720], (POINTS, 2)), np.ones(POINTS)])
        of = poses[rng.integers(frames, size=POINTS)]
        X = np.einsum("nji,nj->ni", of[:, :, :3], depths * (rays @ np.linalg.inv(camera.K).T) - of[:, :, 3])
        seen = [project_through_shutter(camera, path, float(time), readout_s, X) for time in times]
        shown = [np.flatnonzero(np.all((x > 0) & (x < (1280, 720)), axis=1)) for x in seen]
        counts = np.bincount(np.concatenate(shown), minlength=POINTS)
        shown = [points[counts[points] >= 3] for points in shown]
        x = np.concatenate([one[points] for one, points in zip(seen, shown, strict=True)])
        params = np.zeros((1, CAMERA))
        params[0, :4] = camera.K[0, 0], camera.K[1, 1], 640.0, 360.0
        bundle = Bundle(
            params, np.zeros(frames, np.int64), poses[:, :, :3], poses[:, :, 3], X,
            np.repeat(np.arange(frames), [len(points) for points in shown]), np.concatenate(shown),
            x + rng.normal(scale=NOISE_PX, size=x.shape), np.array([PERSPECTIVE]),
        )  # fmt: skip
        return Film(bundle, Rows(times, bundle.x[:, 1] / 720 - 0.5), camera, path)

    return shoot
