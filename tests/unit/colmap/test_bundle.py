"""The last adjustment on models that COLMAP synthesizes."""

import numpy as np
import pytest

from sfm_app.bundle.normal_equations import reduce
from sfm_app.camera.models import camera_matrix
from sfm_app.camera.projection import CAMERA
from sfm_app.colmap.backend import pycolmap
from sfm_app.colmap.bundle import LOSS_SCALE_PX, adjust, read_bundle, solve
from sfm_app.colmap.database import camera_params

pytestmark = pytest.mark.slow

WIDTH, HEIGHT = 1000, 800
PLAIN = [900.0, 900.0, 500.0, 400.0, 0.0, 0.0, 0.0, 0.0]
NAMES = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2")


@pytest.mark.parametrize("radial", [0.0, -0.08])
def test_focal_center_and_lens_are_found_as_far_off_as_stated(mapped, radial):
    true = [900.0, 900.0, 530.0, 380.0, radial, 0.0, 0.0, 0.0]
    found = adjust(*mapped(true, start=(880.0, 500.0, 400.0, radial)))
    camera, deviations = found.model.cameras[1], found.deviations[1]

    assert "center" in found.determined[1]
    assert camera.params[:2] == pytest.approx([900, 900], rel=0.002)
    assert camera.params[2:4] == pytest.approx([530, 380], abs=3)
    assert camera.params[4] == pytest.approx(radial, abs=0.01)
    for name, value, truth in zip(NAMES, camera.params, true, strict=True):
        assert abs(value - truth) < 3 * deviations[name]
    assert 0.1 < deviations["cx"] < 6
    assert 0.2 < found.model.compute_mean_reprojection_error() < 0.5


def test_a_narrow_view_keeps_its_center_and_says_that_it_may_be_off(mapped):
    true = [3000.0, 3000.0, 506.0, 395.0, 0.0, 0.0, 0.0, 0.0]
    found = adjust(*mapped(true, noise_px=0.6, start=(2940.0, 500.0, 400.0, 0.0)))
    camera, deviations = found.model.cameras[1], found.deviations[1]

    assert "center" not in found.determined[1]
    assert tuple(camera.params[2:4]) == (500.0, 400.0)
    assert 4 < deviations["cx"] < 15 and 4 < deviations["cy"] < 15
    assert abs(camera.params[0] - 3000) < 3 * deviations["fx"]


def test_squeezed_photos_have_two_focals_others_one(mapped):
    squeezed = [900.0, 1200.0, 500.0, 400.0, 0.0, 0.0, 0.0, 0.0]
    square = adjust(*mapped(noise_px=1.0)).model.cameras[1].params
    assert square[0] == pytest.approx(square[1], rel=1e-3)
    (model, database), start = mapped(squeezed), camera_matrix(890, 1190, 500, 400)
    model.cameras[1].model = pycolmap.CameraModelId.OPENCV
    model.cameras[1].params = camera_params(start, "OPENCV")

    found = adjust(model, database).model.cameras[1].params

    assert found[:2] == pytest.approx([900, 1200], rel=0.003)


def test_two_photos_change_focal_and_k1_only(mapped):
    found = adjust(*mapped(noise_px=1.0, photos=2, start=(900.0, 500.0, 400.0, 0.0)))

    assert found.model.cameras[1].params[2:4].tolist() == [500.0, 400.0]
    assert found.model.cameras[1].params[5:] == pytest.approx([0, 0, 0], abs=1e-9)
    assert not set(found.determined[1]) - {"k1"}


def test_the_camera_with_most_photos_does_not_free_one_of_a_single_photo(mapped):
    model, database = mapped(photos=5, cameras=2, start=(890.0, 500.0, 400.0, 0.0))
    lone, *others = sorted(image_id for image_id in model.reg_image_ids() if model.images[image_id].camera_id == 2)
    for image_id in others:
        model.deregister_frame(model.images[image_id].frame_id)
    model.tear_down()

    found = adjust(model, database)

    assert found.model.images[lone].has_pose
    assert "center" in found.determined[1] and "center" not in found.determined[2]
    assert found.model.cameras[2].params[2:4].tolist() == [500.0, 400.0]
    for key, tolerance in ((1, 0.003), (2, 0.01)):
        assert found.model.cameras[key].mean_focal_length() == pytest.approx(900, rel=tolerance)


def test_the_same_model_gives_the_same_bytes_and_stays_as_it_was(mapped, tmp_path):
    model, database = mapped()
    before = model.cameras[1].params.copy()

    for name in ("first", "second"):
        (tmp_path / name).mkdir()
        adjust(model, database).model.write(tmp_path / name)

    for file in ("cameras.bin", "images.bin", "points3D.bin"):
        assert (tmp_path / "first" / file).read_bytes() == (tmp_path / "second" / file).read_bytes()
    assert np.array_equal(model.cameras[1].params, before)


def test_the_covariance_of_the_cameras_is_that_of_colmap(mapped):
    model, _ = mapped(cameras=2, photos=4)
    for camera in model.cameras.values():
        camera.model, camera.params = pycolmap.CameraModelId.OPENCV, PLAIN
    solve(model)
    ids, bundle = read_bundle(model)
    H = reduce(bundle, LOSS_SCALE_PX).H
    own = [CAMERA * camera + place for camera in range(2) for place in range(8)]
    ours = np.linalg.inv(H[np.ix_(own, own)])

    theirs = colmap_covariances(model, ids)

    for k, block in enumerate(theirs):
        assert ours[8 * k : 8 * k + 8, 8 * k : 8 * k + 8] == pytest.approx(block, rel=0.02, abs=1e-9)


def colmap_covariances(model, ids):
    options = pycolmap.BundleAdjustmentOptions()
    options.print_summary, options.refine_principal_point = False, True
    options.ceres.loss_function_type = pycolmap.LossFunctionType.SOFT_L1
    options.ceres.loss_function_scale = LOSS_SCALE_PX
    config = pycolmap.BundleAdjustmentConfig()
    for image_id in model.reg_image_ids():
        config.add_image(image_id)
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    adjuster = pycolmap.create_default_ceres_bundle_adjuster(options, config, model)
    settings = pycolmap.BACovarianceOptions()
    settings.params = pycolmap.BACovarianceOptionsParams.ALL
    found = pycolmap.estimate_ba_covariance(settings, model, adjuster)
    return [found.get_other_params_cov(model.cameras[camera_id].params) for camera_id in ids]
