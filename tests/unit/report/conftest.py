"""Matches of photos through any lens."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sfm_app.camera.bearings import project
from sfm_app.camera.models import camera_matrix, panorama_matrix
from sfm_app.geometry.epipolar import cross_matrix
from sfm_app.types import Calibration, CameraPairs

K = camera_matrix(800.0, 800.0, 510.0, 390.0)
CAMERAS = {
    "perspective": Calibration(K, 1000, 800, "zero-curves", True, spread={"fx": 4.0, "fy": 4.0, "cx": 3.0, "cy": 3.0}),
    "fisheye": Calibration(
        camera_matrix(420.0, 420.0, 510.0, 390.0), 1000, 800, "lens", True,
        projection="fisheye", distortion=(-0.02,), spread={"fx": 1.0},
    ),
    "equirectangular": Calibration(
        panorama_matrix((1000, 500)), 1000, 500, "panorama", True, projection="equirectangular"
    ),
}  # fmt: skip
"""One camera of each projection."""


@pytest.fixture(params=CAMERAS)
def camera(request):
    return CAMERAS[request.param]


@pytest.fixture
def make_pairs():
    """Makes the exact pairs of photos by a camera, with noise and an error of the lens (N, 2) -> (N, 2) in pixels."""

    def make(camera, noise_px=0.2, lens_error=np.zeros_like, photos=6, points=800):
        rng = np.random.default_rng(0)
        X = rng.normal(size=(points, 3)) * [4.0, 3.0, 2.0] + [0.0, 0.0, 7.0]
        turns = [Rotation.from_rotvec(rng.normal(0.0, 0.15, 3)).as_matrix() for _ in range(photos)]
        centers = rng.normal(0.0, 0.8, (photos, 3))
        exact = [project((X - c) @ R.T, camera) for R, c in zip(turns, centers, strict=True)]
        with np.errstate(invalid="ignore"):
            inside = [((x > 0) & (x < (camera.width, camera.height))).all(axis=1) for x in exact]
        x = [one + lens_error(one) + rng.normal(0.0, noise_px, one.shape) for one in exact]
        Fs, matches, pairs = [], [], [(a, b) for a in range(photos) for b in range(a + 1, photos)]
        back = np.linalg.inv(camera.K) if camera.projection == "perspective" else np.eye(3)
        for a, b in pairs:
            R, t = turns[b] @ turns[a].T, turns[b] @ (centers[a] - centers[b])
            Fs.append(back.T @ cross_matrix(t / np.linalg.norm(t)) @ R @ back)
            both = inside[a] & inside[b]
            matches.append(np.hstack([x[a][both], x[b][both]]))
        size = camera.width, camera.height
        return CameraPairs(np.array(Fs), np.ones(len(Fs)), size, tuple(pairs), tuple(matches))

    return make
