"""Fundamental matrices of cameras with known K."""

from dataclasses import dataclass
from itertools import combinations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation


@dataclass(frozen=True)
class Views:
    """(P, 3, 3) fundamental matrices and the camera they belong to."""

    Fs: NDArray[np.float64]
    K: NDArray[np.float64]
    size: tuple[int, int]

    @property
    def weights(self):
        return np.ones(len(self.Fs))


def free_motion(rng, count):
    """Cameras in front of a scene, each looking somewhere else in it."""
    turn = rng.uniform(-0.5, 0.5, count)
    centres = np.stack([5 * np.sin(turn), rng.uniform(-1, 1, count), -5 * np.cos(turn)], axis=1)
    centres[:, 2] += rng.uniform(-0.8, 0.8, count)
    return [(_looking(C, rng.normal(0, 0.5, 3), rng.normal(0, 0.3)), C) for C in centres]


def orbit(rng, count):
    """Cameras on a circle that look at its centre."""
    centres = [5 * np.array([np.sin(turn), 0, -np.cos(turn)]) for turn in 0.25 * np.arange(count)]
    return [(_looking(C, np.zeros(3), 0.0), C) for C in centres]


def translation(rng, count):
    """Cameras with parallel axes."""
    return [(np.eye(3), C) for C in rng.normal(size=(count, 3))]


def level(rng, count):
    """Cameras that only pan, at one height."""
    turn = rng.uniform(-0.5, 0.5, count)
    centres = np.stack([5 * np.sin(turn), np.zeros(count), -5 * np.cos(turn)], axis=1)
    return [(_looking(C, rng.normal(0, 0.5, 3) * [1, 0, 1], 0.0), C) for C in centres]


def _looking(centre, target, roll):
    z = (target - centre) / np.linalg.norm(target - centre)
    x = np.cross([0, 1.0, 0], z) / np.linalg.norm(np.cross([0, 1.0, 0], z))
    return Rotation.from_rotvec([0, 0, roll]).as_matrix() @ np.stack([x, np.cross(z, x), z])


def skew(t):
    return np.array([[0, -t[2], t[1]], [t[2], 0, -t[0]], [-t[1], t[0], 0]])


def fundamental(K, first, second, noise):
    """F of two cameras (R, C); `noise` is added to every entry of the unit-norm E, before F."""
    (R1, C1), (R2, C2) = first, second
    E = skew(R2 @ (C1 - C2)) @ R2 @ R1.T
    Ki = np.linalg.inv(K)
    F = Ki.T @ (E / np.linalg.norm(E) + noise) @ Ki
    return F / np.linalg.norm(F)


@pytest.fixture(scope="session")
def views():
    """Makes `Views`: count, seed, noise, motion, and the camera."""

    def make(
        count=6, seed=0, *, noise=1e-3, motion=free_motion, focal=1000.0, aspect=1.0, centre=None, size=(1000, 750)
    ):
        rng = np.random.default_rng(seed)
        cx, cy = centre or (size[0] / 2, size[1] / 2)
        K = np.array([[focal / np.sqrt(aspect), 0, cx], [0, focal * np.sqrt(aspect), cy], [0, 0, 1]])
        cameras = motion(rng, count)
        Fs = [fundamental(K, a, b, rng.normal(0, noise, (3, 3))) for a, b in combinations(cameras, 2)]
        return Views(np.array(Fs), K, size)

    make.orbit, make.translation, make.level = orbit, translation, level
    return make


@pytest.fixture(scope="session")
def random_fundamentals():
    """Matrices that no camera has made: (P, 3, 3) for photos of about 1000 pixels."""

    def make(count, seed=0):
        scale = np.diag([1e-3, 1e-3, 1.0])
        return scale @ np.random.default_rng(seed).normal(size=(count, 3, 3)) @ scale

    return make
