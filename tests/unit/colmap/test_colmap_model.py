"""Cameras and models that COLMAP synthesises, through our side of it."""

import numpy as np
import pytest

from sfm_app.colmap.backend import backend, plain, pycolmap
from sfm_app.colmap.database import SQUARE_PIXELS, TWO_FOCALS, camera_params
from sfm_app.colmap.model import turn_upright
from sfm_app.errors import BackendError, ConfigError


def test_a_model_is_turned_upright_centred_and_scaled():
    pycolmap.set_random_seed(1)
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_cameras_per_rig, options.num_frames_per_rig, options.num_points3D = 1, 1, 8, 400
    model = pycolmap.synthesize_dataset(options)
    error = model.compute_mean_reprojection_error()
    turned = pycolmap.Rotation3d(np.array([[0.0, 1, 0], [0, 0, 1], [1, 0, 0]]))
    model.transform(pycolmap.Sim3d(7.0, turned, np.array([30.0, -5, 2])))

    turn_upright(model)
    points = np.array([point.xyz for point in model.points3D.values()])
    poses = [image.cam_from_world().matrix()[:, :3] for image in model.images.values()]
    up = np.mean([-R[1] for R in poses], axis=0)

    assert np.allclose(np.median(points, axis=0), 0, atol=0.1)
    assert np.percentile(np.linalg.norm(points, axis=1), 80) == pytest.approx(1, abs=0.05)
    if np.linalg.norm(up) > 1e-3:
        assert up[1] / np.linalg.norm(up) == pytest.approx(1, abs=1e-6)
    assert model.compute_mean_reprojection_error() == pytest.approx(error, rel=1e-4)


def test_camera_parameters_of_both_models():
    K = np.array([[800.0, 0, 310], [0, 1250.0, 240], [0, 0, 1]])

    assert camera_params(K, TWO_FOCALS, -0.1) == [800, 1250, 310, 240, -0.1, 0, 0, 0]
    assert camera_params(K, SQUARE_PIXELS) == [1000, 310, 240, 0]


def test_what_colmap_raises_becomes_one_of_ours():
    with (
        pytest.raises(BackendError, match=r"COLMAP failed while reading: .*cannot find it") as caught,
        backend("reading"),
    ):
        raise ValueError("[reconstruction.cc:1] cannot find it\n")
    assert isinstance(caught.value.__cause__, ValueError)
    with pytest.raises(ConfigError), backend("reading"):
        raise ConfigError("ours stays ours")


def test_options_become_plain_values():
    options = plain(pycolmap.FeatureMatchingOptions().todict())

    assert options["sift"]["max_ratio"] == 0.8
    assert isinstance(options["type"], str)
