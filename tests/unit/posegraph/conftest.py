"""Matches of photos whose poses are known."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from sfm_app.camera.bearings import bearings
from sfm_app.camera.models import camera_matrix
from sfm_app.geometry.epipolar import cross_matrix
from sfm_app.posegraph.pair_pose import Pair
from sfm_app.types import Calibration

SIZE = (1000, 750)
K = camera_matrix(900.0, 850.0, 480.0, 390.0)
R = Rotation.from_euler("xyz", [4.0, -12.0, 3.0], degrees=True).as_matrix()
T = np.array([0.9, 0.1, 0.4]) / np.linalg.norm([0.9, 0.1, 0.4])


def projected(X, R, t, radial=0.0, K=K):
    """(N, 2) pixels of points before a camera with this lens."""
    Y = X @ R.T + t
    x = Y[:, :2] / Y[:, 2:]
    return x * (1.0 + radial * (x**2).sum(axis=1, keepdims=True)) * np.diag(K)[:2] + K[:2, 2]


def camera(radial=0.0, **others):
    return Calibration(K, *SIZE, **{"method": "zero-curves", "identifiable": True, "distortion": (radial,), **others})


@dataclass(frozen=True)
class TwoViews:
    """Matches of two photos; the right ones come first."""

    x1: NDArray[np.float64]
    x2: NDArray[np.float64]
    right: int
    R: NDArray[np.float64]
    t: NDArray[np.float64]

    @property
    def rays(self):
        """(N, 4) points of the planes z = 1."""
        return np.hstack([(x - K[:2, 2]) / np.diag(K)[:2] for x in (self.x1, self.x2)])

    @property
    def lines(self):
        """(N, 18) bearing vectors."""
        return np.hstack([bearings(x, camera()) for x in (self.x1, self.x2)])

    @property
    def F(self):
        inverse = np.linalg.inv(K)
        return inverse.T @ cross_matrix(self.t) @ self.R @ inverse

    def pair(self, cameras: Sequence[Calibration] = (), max_error_px=1.5):
        return Pair((self.x1, self.x2), cameras or (camera(), camera()), max_error_px)

    def errors_deg(self, R, t):
        """Of a rotation, and of a direction of translation."""
        turn = Rotation.from_matrix(R.T @ self.R).magnitude()
        return np.degrees([turn, np.arctan2(np.linalg.norm(np.cross(t, self.t)), t @ self.t)])


@pytest.fixture(scope="session")
def two_views():
    """Makes `TwoViews` of a box, of a wall, or of what a turn on the spot shows, with false matches."""

    def make(seed=0, *, right=200, false=0, second=0, noise_px=0.2, radial=0.0, scene="box", R=R, t=T):
        rng = np.random.default_rng([seed, 31])
        X = rng.uniform([-2, -1.5, 4], [2, 1.5, 8], (right + second, 3))
        if scene == "wall":
            X[:, 2] = 6.0 + 0.3 * X[:, 0] - 0.2 * X[:, 1]
        x1, x2 = (
            projected(X, np.eye(3), np.zeros(3), radial),
            projected(X, R, 0.0 * t if scene == "turn" else t, radial),
        )
        # the same points again, one pane of a facade further: another pose explains them
        x2[right:] = projected(X[right:] + np.array([0.6, 0.0, 0.3]), R, t + np.array([0.0, 0.5, -0.2]), radial)
        x1, x2 = (x + rng.normal(0.0, noise_px, x.shape) for x in (x1, x2))
        others = [rng.uniform((0, 0), SIZE, (false, 2)) for _ in range(2)]
        return TwoViews(np.vstack([x1, others[0]]), np.vstack([x2, others[1]]), right, R, t)

    make.camera = camera
    return make
