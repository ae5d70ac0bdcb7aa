"""Cameras and models that COLMAP synthesises, through our side of it."""

import numpy as np
import pytest

from sfm_app.colmap.backend import backend, plain, pycolmap
from sfm_app.colmap.bundle import adjust, main_camera
from sfm_app.colmap.database import SQUARE_PIXELS, TWO_FOCALS, camera_params
from sfm_app.colmap.model import cameras_of, part_of, photos_of, placed_views, turn_upright
from sfm_app.errors import BackendError, ConfigError
from sfm_app.geometry.camera import camera_matrix

WIDTH, HEIGHT = 1000, 800


def synthetic(tmp_path, true_params, noise_px=0.3, photos=8, cameras=1):
    """A COLMAP model with known cameras, so many photos of each, and its database."""
    pycolmap.set_random_seed(1)
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_cameras_per_rig, options.num_frames_per_rig = cameras, 1, photos
    options.num_points3D = 400
    options.camera_width, options.camera_height = WIDTH, HEIGHT
    options.camera_model_id = pycolmap.CameraModelId.OPENCV
    options.camera_params = true_params
    with pycolmap.Database.open(tmp_path / "database.db") as database:
        model = pycolmap.synthesize_dataset(options, database)
        noise = pycolmap.SyntheticNoiseOptions()
        noise.point2D_stddev = noise_px
        pycolmap.synthesize_noise(noise, model, database)
    return model, tmp_path / "database.db"


@pytest.mark.parametrize("radial", [0.0, -0.08])
def test_the_last_adjustment_finds_focal_centre_and_lens(tmp_path, radial):
    true = [900.0, 900.0, 530.0, 380.0, radial, 0.0, 0.0, 0.0]
    model, database = synthetic(tmp_path, true)
    for camera in model.cameras.values():  # as mapping leaves it: one focal, a centre that is off
        camera.model = pycolmap.CameraModelId.SIMPLE_RADIAL
        camera.params = [880.0, 500.0, 400.0, radial]

    found, deviations = adjust(model, database)
    K = main_camera(found).calibration_matrix()

    assert K[0, 0] == pytest.approx(900, rel=0.003)
    assert K[1, 1] == pytest.approx(900, rel=0.003)
    assert np.hypot(K[0, 2] - 530, K[1, 2] - 380) < 6
    assert abs(K[0, 2] - 530) < 4 * deviations["cx"] and abs(K[1, 2] - 380) < 4 * deviations["cy"]
    assert main_camera(found).model.name == TWO_FOCALS
    assert main_camera(found).params[4] == pytest.approx(radial, abs=0.04)
    assert 0.01 < deviations["cx"] < 3
    assert 0.2 < found.compute_mean_reprojection_error() < 0.6


def test_a_centre_that_two_photos_do_not_determine_stays(tmp_path):
    model, database = synthetic(tmp_path, [900.0, 900.0, 500.0, 400.0, 0.0, 0.0, 0.0, 0.0], noise_px=1.0, photos=2)
    for camera in model.cameras.values():
        camera.model = pycolmap.CameraModelId.SIMPLE_RADIAL
        camera.params = [900.0, 500.0, 400.0, 0.0]

    found, deviations = adjust(model, database)
    K = main_camera(found).calibration_matrix()

    assert (K[0, 2], K[1, 2]) == (500.0, 400.0)
    assert "cx" not in deviations


def test_the_camera_with_most_photos_does_not_free_one_of_a_single_photo(tmp_path):
    model, database = synthetic(tmp_path, [900.0, 900.0, 500.0, 400.0, 0.0, 0.0, 0.0, 0.0], photos=5, cameras=2)
    lone, *others = sorted(image_id for image_id in model.reg_image_ids() if model.images[image_id].camera_id == 2)
    for image_id in others:
        model.deregister_frame(model.images[image_id].frame_id)
    model.tear_down()
    for camera in model.cameras.values():
        camera.model = pycolmap.CameraModelId.SIMPLE_RADIAL
        camera.params = [890.0, 500.0, 400.0, 0.0]

    found, _ = adjust(model, database)

    assert main_camera(found).camera_id == 1 and found.images[lone].has_pose
    assert [found.cameras[key].model.name for key in (1, 2)] == [TWO_FOCALS, SQUARE_PIXELS]
    for key, tolerance in ((1, 0.003), (2, 0.01)):
        assert found.cameras[key].mean_focal_length() == pytest.approx(900, rel=tolerance)


def test_a_camera_with_two_focals_keeps_them_beside_one_with_square_pixels(tmp_path):
    model, database = synthetic(tmp_path, [900.0, 900.0, 500.0, 400.0, 0.0, 0.0, 0.0, 0.0], photos=2, cameras=2)
    for camera in model.cameras.values():
        camera.model = pycolmap.CameraModelId.SIMPLE_RADIAL if camera.camera_id == 1 else pycolmap.CameraModelId.OPENCV
        camera.params = camera_params(camera_matrix(890, 890, 500, 400), camera.model.name)

    found, deviations = adjust(model, database)

    assert found.cameras[2].model.name == TWO_FOCALS
    assert found.cameras[1].mean_focal_length() == pytest.approx(900, rel=0.01)
    assert set(deviations) <= {"f", "fx", "fy"}


def test_a_model_is_turned_upright_centred_and_scaled(tmp_path):
    model, _ = synthetic(tmp_path, [900.0, 900.0, 500.0, 400.0, 0.0, 0.0, 0.0, 0.0])
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


def test_placed_views_see_the_points_where_they_are(tmp_path):
    """Through a lens, with two focals: the rays of keypoints meet the model's points."""
    model, _ = synthetic(tmp_path, [900.0, 850.0, 510.0, 390.0, -0.1, 0.0, 0.0, 0.0], noise_px=0.0, photos=4)
    model.deregister_frame(model.images[4].frame_id)
    keypoints = {key: np.array([p.xy for p in image.points2D]) for key, image in model.images.items()}

    views = placed_views(model, keypoints)

    assert sorted(views) == [1, 2, 3]
    for key, view in views.items():
        seen = [(k, p.point3D_id) for k, p in enumerate(model.images[key].points2D) if p.has_point3D()]
        X = np.array([model.points3D[number].xyz for _, number in seen]) @ view.R.T + view.t
        np.testing.assert_allclose(view.rays[[k for k, _ in seen]], X[:, :2] / X[:, 2:], atol=1e-5)
        assert view.focals.tolist() == [900.0, 850.0]


@pytest.mark.parametrize(
    ("name", "params", "focals"),
    [("SIMPLE_RADIAL", [880.0, 510.0, 390.0, -0.1], (880, 880)),
     ("OPENCV", [900.0, 850.0, 510.0, 390.0, -0.1, 0.02, 0.0, 0.0], (900, 850))],
)  # fmt: skip
def test_cameras_are_read_with_their_first_radial_term(tmp_path, name, params, focals):
    model, _ = synthetic(tmp_path, [900.0, 900.0, 500.0, 400.0, 0.0, 0.0, 0.0, 0.0], photos=3)
    model.deregister_frame(model.images[2].frame_id)
    for camera in model.cameras.values():
        camera.model = getattr(pycolmap.CameraModelId, name)
        camera.params = params

    found = cameras_of(model)

    assert sorted(found) == [1, 3]
    for K, radial in found.values():
        assert (K[0, 0], K[1, 1], K[0, 2], K[1, 2], radial) == (*focals, 510.0, 390.0, -0.1)


def test_a_part_of_a_model_can_be_adjusted_and_the_whole_stays(tmp_path):
    model, database = synthetic(tmp_path, [900.0, 900.0, 500.0, 400.0, 0.0, 0.0, 0.0, 0.0], photos=6)

    part = part_of(model, (1, 3, 4))
    found, deviations = adjust(part, database)

    assert photos_of(found) == sorted(found.images) == [1, 3, 4] and photos_of(model) == [1, 2, 3, 4, 5, 6]
    assert all(point.track.length() >= 2 for point in found.points3D.values())
    assert found.num_points3D() > 350
    assert "f" in deviations or "fx" in deviations


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
