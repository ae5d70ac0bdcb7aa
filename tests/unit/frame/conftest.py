"""Photos of a house from a few steps away, as poses, points and line segments with known up."""

from dataclasses import dataclass

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sfm_app.frame.vanishing_points import Segments, concatenate_segments, segment_planes
from sfm_app.synthetic.cameras import axis_rotation, look_at
from sfm_app.types.scene import camera_center

FOCAL_PX = 1000.0


@dataclass(frozen=True)
class House:
    """A scene with y up, seen from +z, then turned as a whole by an unknown rotation."""

    rotations: np.ndarray
    centers: np.ndarray
    points: np.ndarray
    segments: Segments
    turned: np.ndarray

    @property
    def up(self):
        return self.turned[:, 1]

    @property
    def front(self):
        return self.turned[:, 2]


def edges(rng, directions, count):
    """Both ends (2, N, 3) of edges of a house 4 wide, 3 high, 3 deep, that run in given directions."""
    middles = rng.uniform([-2, 0, -1.5], [2, 3, 1.5], (count, 3))
    ways = np.asarray(directions)[rng.integers(0, len(directions), count)]
    half = 0.5 * rng.uniform(0.3, 1.2, (count, 1)) * ways
    return np.stack([middles - half, middles + half])


def house(rolls_deg, *, aim_y=2.0, lines=(150, 150), clutter=100, noise_px=0.5, level_deg=0.0, sweep_deg=50.0, seed=0):
    """Photos from a walk in front, rolled by so many degrees each, with vertical and horizontal edges and clutter."""
    rng = np.random.default_rng(seed)
    turned = Rotation.random(random_state=seed + 5).as_matrix()
    azimuths = np.radians(np.linspace(-sweep_deg / 2, sweep_deg / 2, len(rolls_deg)))
    sideways = axis_rotation(np.array([0.0, 1.0, 0.0]), level_deg)
    vertical = edges(rng, [[0, 1, 0]], lines[0])
    level = edges(rng, sideways.T[[0, 2]], lines[1])
    wild = edges(rng, Rotation.random(1000, random_state=seed).as_matrix()[:, 0], clutter)
    ends = np.concatenate([vertical, level, wild], axis=1)
    parts, rotations, centers = [], [], []
    for k, (azimuth, roll) in enumerate(zip(azimuths, rolls_deg, strict=True)):
        place = np.array([9 * np.sin(azimuth), 1.6 + 0.1 * rng.normal(), 9 * np.cos(azimuth)])
        pose = look_at(place, np.array([0.0, aim_y, 0.0]) + 0.2 * rng.normal(size=3), roll)
        x = ends @ pose[:, :3].T + pose[:, 3]
        x = x / x[..., 2:]
        x[..., :2] += rng.normal(scale=noise_px / FOCAL_PX, size=x[..., :2].shape)
        R = pose[:, :3] @ turned.T
        parts.append(segment_planes(*(x @ R), k, FOCAL_PX))
        rotations.append(R)
        centers.append(turned @ camera_center(pose))
    points = rng.uniform([-2, 0, -1.5], [2, 3, 1.5], (400, 3)) @ turned.T
    return House(np.array(rotations), np.array(centers), points, concatenate_segments(parts), turned)


@pytest.fixture
def build_house():
    return house
