"""Photos of COLMAP's making, and what the steps before found in them."""

import shutil
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from sfm_app.camera.models import camera_matrix
from sfm_app.colmap.backend import pycolmap
from sfm_app.colmap.database import open_database
from sfm_app.geometry.epipolar import eight_point
from sfm_app.progress import SilentProgress
from sfm_app.runtime.workspace import Workspace
from sfm_app.settings import Settings
from sfm_app.types import Calibration, EpipolarFit, Intrinsics, MatchedImage, MatchGraph, ViewGraph

FOCAL, WIDTH, HEIGHT = 1280.0, 1024, 768


@dataclass(frozen=True)
class Synthetic:
    """Photos 1 to 6 around some points; the first 100 matches of a pair are right, the last 20 are not."""

    database: Path
    model: Any
    matches: MatchGraph
    views: ViewGraph

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
            seed=0,
            workers=2,
            progress=SilentProgress(),
            map=lambda function, items, _: [function(item) for item in items],
        )

    return make
