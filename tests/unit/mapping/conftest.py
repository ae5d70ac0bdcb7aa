"""Photos of COLMAP and a street of photos in two parts, with matches and geometry."""

import shutil
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sfm_app.camera.models import camera_matrix
from sfm_app.colmap.backend import pycolmap
from sfm_app.colmap.database import open_database
from sfm_app.colmap.joined_model import PlacedPhotos
from sfm_app.geometry.epipolar import eight_point, fundamental_from_pose
from sfm_app.geometry.poses import Similarity
from sfm_app.mapping.joins import Fragment
from sfm_app.plugins import load_plugins
from sfm_app.progress import Progress
from sfm_app.runtime.workspace import Workspace
from sfm_app.settings import Settings
from sfm_app.types import Calibration, EpipolarFit, Evidence, Intrinsics, MatchedImage, MatchGraph, ViewGraph
from tests.unit.mapping.fakes import Fakes

FOCAL, WIDTH, HEIGHT = 1280.0, 1024, 768


@dataclass(frozen=True)
class Synthetic:
    """Photos 1 to 6 around some points; the first 100 matches of a pair are right, the last 20 are not."""

    database: Path
    model: Any
    matches: MatchGraph
    views: ViewGraph

    def evidence(self, intrinsics=None):
        return Evidence(self.matches, self.views, intrinsics)

    def copy(self):
        """The true model, to be changed."""
        return pycolmap.Reconstruction(self.model)


def _graph(database, model):
    keypoints, rows, rng = {}, {}, np.random.default_rng(0)
    with open_database(database) as db:
        for key in sorted(model.images):
            keypoints[key] = np.asarray(db.read_keypoints(key), np.float64)[:, :2]
        pairs = [(a, b) for a in sorted(keypoints) for b in sorted(keypoints) if a < b]
        for pair in pairs:
            right = np.asarray(db.read_matches(*pair), np.uint32)
            false = np.column_stack([rng.permutation(len(right))[:20] for _ in pair])
            rows[pair] = np.vstack([right, false.astype(np.uint32)])
    images = {key: MatchedImage(key, model.images[key].name, "one", WIDTH, HEIGHT) for key in keypoints}
    return MatchGraph(images, keypoints, rows)


def _views(matches):
    fits = {}
    for pair in matches.matches:
        x1, x2 = (x[:100] for x in matches.points(pair))
        fits[pair] = EpipolarFit(eight_point(x1, x2), np.arange(120) < 100, np.ones(120), 10, 0.3)
    return ViewGraph(fits, {})


@pytest.fixture(scope="session")
def synthetic(tmp_path_factory):
    place = tmp_path_factory.mktemp("synthetic")
    pycolmap.set_random_seed(1)
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_cameras_per_rig, options.num_frames_per_rig = 1, 1, 6
    options.num_points3D, options.num_points2D_without_point3D = 100, 0
    options.camera_width, options.camera_height = WIDTH, HEIGHT
    options.camera_params = [FOCAL, WIDTH / 2, HEIGHT / 2, 0.0]
    noise = pycolmap.SyntheticNoiseOptions()
    noise.point2D_stddev = 0.2
    with open_database(place / "database.db") as database:
        model = pycolmap.synthesize_dataset(options, database)
        pycolmap.synthesize_noise(noise, model, database)
    matches = _graph(place / "database.db", model)
    return Synthetic(place / "database.db", model, matches, _views(matches))


@pytest.fixture(scope="session")
def cameras():
    """Makes `Intrinsics` of one camera that the photos determine, unless told otherwise."""

    def make(focal=FOCAL, **others):
        K = camera_matrix(focal, focal, WIDTH / 2, HEIGHT / 2)
        return Intrinsics(
            {"one": Calibration(K, WIDTH, HEIGHT, **{"method": "zero-curves", "identifiable": True, **others})}
        )

    return make


@pytest.fixture
def run(synthetic, tmp_path):
    """Makes the context of a run with a copy of the database, and these settings of the scene stage."""
    shutil.copyfile(synthetic.database, tmp_path / "database.db")

    def make(**scene):
        return SimpleNamespace(
            settings=Settings.from_mapping({"scene": scene}),
            workspace=Workspace(tmp_path),
            plugins=load_plugins(installed=False),
            seed=0,
            workers=2,
            progress=Progress(),
            map=lambda function, items, _: [function(item) for item in items],
        )

    return make


@pytest.fixture
def mapped(synthetic):
    """Mappers that find the models of a test."""
    return Fakes(synthetic)


PHOTOS, POINTS, REACH = 40, 600, 8.0
K = camera_matrix(1000.0, 1000.0, 600.0, 450.0)
ELSEWHERE = Similarity(2.5, Rotation.from_rotvec([0.3, -1.2, 0.8]).as_matrix(), np.array([4.0, -7.0, 2.0]))
"""From the frame of the second part into that of the street."""


class Street:
    """Photos 1 to 40 along x, half a unit apart, that look at points around z = 6; keypoints are numbered as points."""

    def __init__(self):
        rng = np.random.default_rng(5)
        self.R = Rotation.from_rotvec(rng.normal(scale=0.1, size=(PHOTOS, 3))).as_matrix()
        steps = 0.5 * np.arange(PHOTOS)
        self.centers = np.column_stack([steps, rng.normal(scale=0.1, size=(PHOTOS, 2))])
        wide = np.column_stack([rng.uniform(-4, 24, POINTS), rng.uniform(-2, 2, POINTS)])
        self.X = np.column_stack([wide, rng.uniform(5, 7, POINTS)])
        self.seen = [np.flatnonzero(np.abs(self.X[:, 0] - x) < REACH / 2) for x in steps]
        self.rng = rng

    def pixels(self, photo):
        local = (self.X - self.centers[photo - 1]) @ self.R[photo - 1].T @ K.T
        return local[:, :2] / local[:, 2:]

    def placed(self, photos, frame=None, noise=0.01):
        """A model of some photos, in another frame (from that into the street's)."""
        frame = frame or Similarity(1.0, np.eye(3), np.zeros(3))
        back = frame.inverse()
        ids = np.array(sorted(photos))
        R = self.R[ids - 1] @ frame.R
        turn = Rotation.from_rotvec(self.rng.normal(scale=0.1 * noise, size=(len(ids), 3))).as_matrix()
        views = {photo: self.seen[photo - 1] for photo in ids.tolist()}
        count = np.bincount(np.concatenate(list(views.values())), minlength=POINTS)
        known = np.flatnonzero(count >= 2)
        element = sorted((int(p), photo) for photo, seen in views.items() for p in seen if count[p] >= 2)
        point, photo = np.array(element).T
        camera = pycolmap.Camera(model="SIMPLE_RADIAL", width=1200, height=900, params=[1000.0, 600.0, 450.0, 0.0])
        return PlacedPhotos(
            ids,
            turn @ R,
            back(self.centers[ids - 1] + self.rng.normal(scale=noise, size=(len(ids), 3))),
            back(self.X[known] + self.rng.normal(scale=noise, size=(len(known), 3))),
            np.searchsorted(known, point),
            photo,
            point,
            dict.fromkeys(ids.tolist(), camera),
        )

    def graphs(self):
        """Matches and fundamental matrices of all pairs that see the same points."""
        images = {k: MatchedImage(k, f"{k:03d}.jpg", "one", 1200, 900) for k in range(1, PHOTOS + 1)}
        keypoints = {k: self.pixels(k) for k in images}
        rows, fits = {}, {}
        for a in images:
            for b in range(a + 1, PHOTOS + 1):
                both = np.intersect1d(self.seen[a - 1], self.seen[b - 1])
                if len(both) >= 20:
                    rows[a, b] = np.column_stack([both, both]).astype(np.uint32)
                    R = self.R[b - 1] @ self.R[a - 1].T
                    F = fundamental_from_pose(K, K, R, self.R[b - 1] @ (self.centers[a - 1] - self.centers[b - 1]))
                    fits[a, b] = EpipolarFit(
                        F / np.linalg.norm(F), np.ones(len(both), bool), np.ones(len(both)), 9, 0.1
                    )
        return MatchGraph(images, keypoints, rows), ViewGraph(fits, {})


@pytest.fixture
def street():
    return Street()


@pytest.fixture
def two_parts(street):
    """Photos 1 to 24 in the street's frame, and 17 to 40 elsewhere; each owns 20."""
    first = Fragment(0, frozenset(range(1, 21)), street.placed(range(1, 25)))
    second = Fragment(1, frozenset(range(21, 41)), street.placed(range(17, 41), ELSEWHERE))
    return SimpleNamespace(fragments=[first, second], true=ELSEWHERE)
