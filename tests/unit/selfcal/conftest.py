"""Fundamental matrices, and matches, of cameras with known K."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from itertools import combinations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from sfm_app.fundamental.refits import refine_sampson
from sfm_app.geometry.epipolar import eight_point
from sfm_app.selfcal import pair_weights
from sfm_app.types import CameraPairs, PhotoPairs


@dataclass(frozen=True)
class Views:
    """(P, 3, 3) fundamental matrices and their camera."""

    Fs: NDArray[np.float64]
    K: NDArray[np.float64]
    size: tuple[int, int]

    @property
    def weights(self):
        return np.ones(len(self.Fs))


@dataclass(frozen=True)
class Shots:
    """Photos of random points: the input of a calibrator, and the cameras."""

    pairs: CameraPairs
    Ks: NDArray[np.float64]
    sizes: Mapping[int, tuple[int, int]] = field(default_factory=dict)

    def as_set(self, groups, priors=None):
        """`PhotoPairs` with the group of every photo."""
        p = self.pairs
        return PhotoPairs(p.Fs, p.weights, p.photos, p.inliers, self.sizes, dict(enumerate(groups)), priors or {})


def looking(center, target, roll):
    z = (target - center) / np.linalg.norm(target - center)
    x = np.cross([0, 1.0, 0], z) / np.linalg.norm(np.cross([0, 1.0, 0], z))
    return Rotation.from_rotvec([0, 0, roll]).as_matrix() @ np.stack([x, np.cross(z, x), z])


# motions: random generator and number of cameras -> (R, C) of each


def free_motion(rng, count):
    """Cameras in front of a scene, each directed at another point of it."""
    turn = rng.uniform(-0.5, 0.5, count)
    centers = np.stack([5 * np.sin(turn), rng.uniform(-1, 1, count), -5 * np.cos(turn)], axis=1)
    centers[:, 2] += rng.uniform(-0.8, 0.8, count)
    return [(looking(C, rng.normal(0, 0.5, 3), rng.normal(0, 0.3)), C) for C in centers]


def orbit(rng, count):
    """Cameras on a circle, directed at its center."""
    centers = [5 * np.array([np.sin(turn), 0, -np.cos(turn)]) for turn in 0.25 * np.arange(count)]
    return [(looking(C, np.zeros(3), 0.0), C) for C in centers]


def level(rng, count):
    """Cameras that only pan, at one height."""
    turn = rng.uniform(-0.5, 0.5, count)
    centers = np.stack([5 * np.sin(turn), np.zeros(count), -5 * np.cos(turn)], axis=1)
    return [(looking(C, rng.normal(0, 0.5, 3) * [1, 0, 1], 0.0), C) for C in centers]


def translation(rng, count):
    """Cameras with parallel axes."""
    return [(np.eye(3), C) for C in rng.normal(size=(count, 3))]


def parallel(rng, count):
    """Cameras with parallel axes in front of the scene."""
    return [(np.eye(3), np.array([0, 0, -5.0]) + C) for C in rng.uniform(-0.8, 0.8, (count, 3))]


def turning(rng, count):
    """Cameras that hardly leave one place."""
    centers = np.array([0, 0, -5.0]) + rng.normal(0, 0.02, (count, 3))
    return [(looking(C, rng.normal(0, 0.5, 3), rng.normal(0, 0.2)), C) for C in centers]


def onward(rng, count):
    """Cameras that go straight ahead."""
    centers = np.array([0, 0, -5.0]) + np.linspace(-1, 1, count)[:, None] * [0.05, 0.02, 1]
    return [(Rotation.from_rotvec(rng.normal(0, 0.01, 3)).as_matrix(), C) for C in centers]


def fundamental(K, first, second, noise):
    """F of two cameras (R, C); `noise` is added to every entry of the unit-norm E."""
    (R1, C1), (R2, C2) = first, second
    t, Ki = R2 @ (C1 - C2), np.linalg.inv(K)
    E = np.array([[0, -t[2], t[1]], [t[2], 0, -t[0]], [-t[1], t[0], 0]]) @ R2 @ R1.T
    F = Ki.T @ (E / np.linalg.norm(E) + noise) @ Ki
    return F / np.linalg.norm(F)


@pytest.fixture(scope="session")
def views():
    """Makes `Views`: count, seed, noise, motion, and the camera."""

    def make(
        count=6, seed=0, *, noise=1e-3, motion=free_motion, focal=1000.0, aspect=1.0, center=None, size=(1000, 750)
    ):
        rng = np.random.default_rng(seed)
        cx, cy = center or (size[0] / 2, size[1] / 2)
        K = np.array([[focal / np.sqrt(aspect), 0, cx], [0, focal * np.sqrt(aspect), cy], [0, 0, 1]])
        cameras = motion(rng, count)
        Fs = [fundamental(K, a, b, rng.normal(0, noise, (3, 3))) for a, b in combinations(cameras, 2)]
        return Views(np.array(Fs), K, size)

    make.orbit, make.translation, make.level = orbit, translation, level
    return make


@pytest.fixture(scope="session")
def random_fundamentals():
    """Matrices of no camera: (P, 3, 3) for photos of about 1000 pixels."""

    def make(count, seed=0):
        scale = np.diag([1e-3, 1e-3, 1.0])
        return scale @ np.random.default_rng(seed).normal(size=(count, 3, 3)) @ scale

    return make


def photograph(X, pose, K, k1):
    """(N, 2) pixels without noise, and (N,) which points lie before the camera."""
    R, C = pose
    x = (X - C) @ R.T
    rays = x[:, :2] / np.where(x[:, 2:] > 0.1, x[:, 2:], 1.0)
    rays = rays * (1 + k1 * np.sum(rays**2, axis=1, keepdims=True))
    return rays * [K[0, 0], K[1, 1]] + K[:2, 2], x[:, 2] > 0.1


def match(motion, seed, points, Ks, sizes, k1, noise_px):
    """F's, photos and matches of all pairs with 16 matches or more."""
    rng, unit = np.random.default_rng([seed, 7]), np.diag([1e-3, 1e-3, 1.0])
    poses, X = motion(rng, len(Ks)), rng.uniform(-1.6, 1.6, (points, 3))
    photos = []
    for pose, K, size in zip(poses, Ks, sizes, strict=True):
        x, before = photograph(X, pose, K, k1)
        x = x + noise_px * rng.normal(size=x.shape)
        photos.append((x, before & np.all((x >= 0) & (x <= size), axis=1)))
    Fs, ids, inliers = [], [], []
    for i, j in combinations(range(len(Ks)), 2):
        both = photos[i][1] & photos[j][1]
        if np.count_nonzero(both) >= 16:
            x = np.hstack([photos[i][0][both], photos[j][0][both]])
            start = np.linalg.inv(unit) @ eight_point(x[:, :2], x[:, 2:]) @ np.linalg.inv(unit)
            Fs.append(unit @ refine_sampson(np.asfortranarray(x * 1e-3), start, scale=3e-3) @ unit)
            ids.append((i, j))
            inliers.append(x)
    return np.array(Fs).reshape(-1, 3, 3), tuple(ids), tuple(inliers)


@pytest.fixture(scope="session")
def shots():
    """Makes `Shots`: number of photos, seed, motion, lens, noise; focals and sizes may differ from photo to photo."""

    def make(
        count=6, seed=0, *, motion=free_motion, focal=1000.0, aspect=1.0, center=(0.5, 0.5), size=(1000, 750), k1=0.0,
        noise_px=0.5, points=250, prior=None,
    ):  # fmt: skip
        sizes, root = [size] * count if isinstance(size[0], int) else list(size), np.sqrt(aspect)
        Ks = np.array(
            [[[f / root, 0, w * center[0]], [0, f * root, h * center[1]], [0, 0, 1]]
             for f, (w, h) in zip(np.broadcast_to(focal, count), sizes, strict=True)]
        )  # fmt: skip
        Fs, ids, inliers = match(motion, seed, points, Ks, sizes, k1, noise_px)
        weights = pair_weights([len(x) for x in inliers])
        return Shots(CameraPairs(Fs, weights, sizes[0], ids, inliers, prior), Ks, dict(enumerate(sizes)))

    make.free, make.orbit, make.level = free_motion, orbit, level
    make.parallel, make.turning, make.onward = parallel, turning, onward
    return make
