"""COLMAP models with known cameras."""

import pytest

from sfm_app.colmap.backend import pycolmap
from sfm_app.colmap.database import SQUARE_PIXELS

WIDTH, HEIGHT = 1000, 800
PLAIN = [900.0, 900.0, 500.0, 400.0, 0.0, 0.0, 0.0, 0.0]


@pytest.fixture
def synthetic(tmp_path_factory):
    """Makes a model with OPENCV cameras of these parameters, so many photos of each, and its database."""

    def make(true_params=PLAIN, noise_px=0.3, photos=8, cameras=1, seed=1):
        database_path = tmp_path_factory.mktemp("synthetic") / "database.db"
        pycolmap.set_random_seed(seed)
        options = pycolmap.SyntheticDatasetOptions()
        options.num_rigs, options.num_cameras_per_rig, options.num_frames_per_rig = cameras, 1, photos
        options.num_points3D = 400
        options.camera_width, options.camera_height = WIDTH, HEIGHT
        options.camera_model_id = pycolmap.CameraModelId.OPENCV
        options.camera_params = true_params
        with pycolmap.Database.open(database_path) as database:
            model = pycolmap.synthesize_dataset(options, database)
            noise = pycolmap.SyntheticNoiseOptions()
            noise.point2D_stddev = noise_px
            pycolmap.synthesize_noise(noise, model, database)
        return model, database_path

    return make


@pytest.fixture
def mapped(synthetic):
    """Makes a model as mapping leaves it: one focal, a center that may be off; and its database."""

    def make(true_params=PLAIN, noise_px=0.3, photos=8, cameras=1, start=(880.0, 500.0, 400.0, 0.0), seed=1):
        model, database = synthetic(true_params, noise_px, photos, cameras, seed)
        for point_id in [key for key, point in model.points3D.items() if point.track.length() < 2]:
            model.delete_point3D(point_id)
        for camera in model.cameras.values():
            camera.model = getattr(pycolmap.CameraModelId, SQUARE_PIXELS)
            camera.params = start
        return model, database

    return make
