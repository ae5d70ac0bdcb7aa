"""The last bundle adjustment: cameras of all families, given cameras, and models that have gone astray."""

from dataclasses import replace

import numpy as np
import pytest

from sfm_app.bundle.lens_parts import CameraRule
from sfm_app.bundle.normal_equations import bundle_scale, reduce
from sfm_app.camera.models import calibration_from_model, camera_matrix
from sfm_app.camera.rows import CAMERA, FISHEYE, FX, K1, K2, K3, P1, PANORAMA
from sfm_app.colmap import bundle
from sfm_app.colmap.backend import pycolmap
from sfm_app.colmap.bundle import adjust, adjust_or_keep, find_cameras, read_bundle, solve, write_camera
from sfm_app.colmap.database import open_database
from sfm_app.colmap.model import camera_family, read_camera
from sfm_app.errors import BackendError, NumericalError
from sfm_app.estimation.given_cameras import find_contradictions
from sfm_app.numerical import json_text
from sfm_app.types.camera import KEPT

pytestmark = pytest.mark.slow

SIZE = (1000, 800)
PLAIN = [900.0, 900.0, 500.0, 400.0, 0.0, 0.0, 0.0, 0.0]
NAMES = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2")


@pytest.mark.parametrize("radial", [0.0, -0.08])
def test_focal_center_and_lens_are_found_as_far_off_as_stated(mapped, radial):
    true = [900.0, 900.0, 530.0, 380.0, radial, 0.0, 0.0, 0.0]
    found = adjust(*mapped(true, start=(880.0, 500.0, 400.0, radial)))
    camera, deviations = found.model.cameras[1], found.refined[1]["deviations"]

    assert "center" in found.refined[1]["determined"] and camera.params[:2] == pytest.approx([900, 900], rel=0.002)
    assert camera.params[2:4] == pytest.approx([530, 380], abs=3)
    assert camera.params[4] == pytest.approx(radial, abs=0.01)
    for name, value, truth in zip(NAMES, camera.params, true, strict=True):
        assert abs(value - truth) < 3 * deviations[name]
    assert 0.1 < deviations["cx"] < 6 and 0.2 < found.model.compute_mean_reprojection_error() < 0.5


def test_squeezed_photos_have_two_focals_others_one(mapped):
    squeezed = [900.0, 1200.0, 500.0, 400.0, 0.0, 0.0, 0.0, 0.0]
    square = adjust(*mapped(noise_px=1.0)).model.cameras[1].params
    assert square[0] == pytest.approx(square[1], rel=1e-3)
    (model, database), start = mapped(squeezed), camera_matrix(890, 1190, 500, 400)
    model.cameras[1].model = pycolmap.CameraModelId.OPENCV
    model.cameras[1].params = [start[0, 0], start[1, 1], *start[:2, 2], *[0.0] * 4]
    found = adjust(model, database).model.cameras[1].params
    assert found[:2] == pytest.approx([900, 1200], rel=0.003)


def turn_photos(model):
    for key, image in model.images.items():
        pose = image.cam_from_world()
        pose.rotation = pycolmap.Rotation3d(np.array([key, 1.0, -key, 2.0]) / np.hypot(np.sqrt(2) * key, np.sqrt(5)))
        model.frames[image.frame_id].set_cam_from_world(image.camera_id, pose)


def test_poses_too_far_off_for_a_linear_step_are_adjusted_all_the_same(mapped):
    model, database = mapped()
    best = adjust(model, database).model.compute_mean_reprojection_error()
    turn_photos(model)
    assert adjust(model, database).model.compute_mean_reprojection_error() < 1.2 * best


def test_the_camera_with_most_photos_does_not_free_one_of_a_single_photo(mapped):
    model, database = mapped(photos=5, cameras=2, start=(890.0, 500.0, 400.0, 0.0))
    lone, *others = sorted(image_id for image_id in model.reg_image_ids() if model.images[image_id].camera_id == 2)
    for image_id in others:
        model.deregister_frame(model.images[image_id].frame_id)
    model.tear_down()

    found = adjust(model, database)

    assert found.model.images[lone].has_pose
    assert "center" in found.refined[1]["determined"] and "center" not in found.refined[2]["determined"]
    assert found.model.cameras[2].params[2:4].tolist() == [500.0, 400.0]
    for key, tolerance in ((1, 0.003), (2, 0.01)):
        assert found.model.cameras[key].mean_focal_length() == pytest.approx(900, rel=tolerance)


def test_the_covariance_of_the_cameras_is_that_of_colmap(mapped):
    model, _ = mapped(cameras=2, photos=4)
    for camera in model.cameras.values():
        camera.model, camera.params = pycolmap.CameraModelId.OPENCV, PLAIN
    solve(model)
    ids, bundle = read_bundle(model)
    H = reduce(bundle, bundle_scale(bundle)).H
    own = [CAMERA * camera + place for camera in range(2) for place in range(8)]
    ours = np.linalg.inv(H[np.ix_(own, own)])

    theirs = colmap_covariances(model, ids)

    for k, block in enumerate(theirs):
        assert ours[8 * k : 8 * k + 8, 8 * k : 8 * k + 8] == pytest.approx(block, rel=0.02, abs=1e-9)


def colmap_covariances(model, ids):
    options = pycolmap.BundleAdjustmentOptions()
    options.print_summary, options.refine_principal_point = False, True
    options.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
    options.ceres.loss_function_scale = bundle_scale(read_bundle(model)[1])
    config = pycolmap.BundleAdjustmentConfig()
    for image_id in model.reg_image_ids():
        config.add_image(image_id)
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    adjuster = pycolmap.create_default_ceres_bundle_adjuster(options, config, model)
    settings = pycolmap.BACovarianceOptions()
    settings.params = pycolmap.BACovarianceOptionsParams.ALL
    found = pycolmap.estimate_ba_covariance(settings, model, adjuster)
    return [found.get_other_params_cov(model.cameras[camera_id].params) for camera_id in ids]


def camera_of(model, params, camera_id=1, size=SIZE):
    kind = pycolmap.CameraModelId.__members__[model]
    return pycolmap.Camera(camera_id=camera_id, model=kind, width=size[0], height=size[1], params=params)


PANORAMIC = ("EQUIRECTANGULAR", [1000.0, 500.0], (1000, 500))
CAMERAS = [
    ("SIMPLE_RADIAL", [900.0, 510.0, 390.0, -0.1], SIZE),
    ("OPENCV", [900.0, 910.0, 510.0, 390.0, -0.1, 0.02, 0.001, -0.002], SIZE),
    ("FULL_OPENCV", [900.0, 910.0, 510.0, 390.0, -0.1, 0.02, 0.001, -0.002, 0.01, 0.02, -0.01, 0.01], SIZE),
    ("OPENCV_FISHEYE", [400.0, 410.0, 510.0, 390.0, -0.02, 0.01, -0.001, 0.002], SIZE),
    ("THIN_PRISM_FISHEYE", [400.0, 400.0, 510.0, 390.0, -0.02, 0.01, 0.001, -0.002, 0.01, 0.02, 0.001, -0.001],
     SIZE),
    PANORAMIC,
]  # fmt: skip


@pytest.mark.parametrize(("model", "params", "size"), CAMERAS)
def test_a_camera_is_the_same_after_a_round_trip_in_the_smallest_model_that_holds_it(model, params, size):
    camera, other = camera_of(model, params, size=size), camera_of(model, params, size=size)
    points = np.random.default_rng(0).uniform([-1, -1, 1], [1, 1, 3], (20, 3))
    write_camera(other, read_camera(camera), camera_family(camera))
    assert other.model.name == ("OPENCV" if model == "SIMPLE_RADIAL" else model)
    assert np.asarray(other.img_from_cam(points)) == pytest.approx(np.asarray(camera.img_from_cam(points)), abs=1e-9)


def seen_through(model, camera_id, camera, rng):
    """Let another camera take the photos of one: their keypoints move to where it sees the points."""
    model.cameras[camera_id].width, model.cameras[camera_id].height = camera.width, camera.height
    model.cameras[camera_id].model, model.cameras[camera_id].params = camera.model, camera.params
    for image in model.images.values():
        if image.camera_id == camera_id:
            for keypoint in image.points2D:
                if keypoint.has_point3D():
                    X = image.cam_from_world() * model.points3D[keypoint.point3D_id].xyz
                    keypoint.xy = np.asarray(camera.img_from_cam(X[None]))[0] + rng.normal(scale=0.3, size=2)


@pytest.fixture
def mixed(synthetic):
    """A model of three cameras as mapping leaves it: perspective, fisheye, panorama."""
    model, database = synthetic(cameras=3, photos=6)
    for point_id in [key for key, point in model.points3D.items() if point.track.length() < 3]:
        model.delete_point3D(point_id)
    rng = np.random.default_rng(0)
    fisheye = camera_of("OPENCV_FISHEYE", [400.0, 400.0, 505.0, 396.0, 0.0, 0.0, 0.0, 0.0], 2)
    seen_through(model, 2, fisheye, rng)
    seen_through(model, 3, camera_of(*PANORAMIC[:2], 3, PANORAMIC[2]), rng)
    model.cameras[1].model = pycolmap.CameraModelId.SIMPLE_RADIAL
    model.cameras[1].params = [890.0, 500.0, 400.0, 0.0]
    model.cameras[2].params = [402.0, 402.0, 500.0, 400.0, 0.01, 0.0, 0.001, 0.0]
    return model, database


def test_cameras_of_three_families_are_adjusted_together_and_named_with_their_rivals(mixed):
    before = mixed[0].compute_num_observations()

    found = adjust(*mixed)

    cameras = found.model.cameras
    assert [cameras[key].model.name for key in (1, 2, 3)] == ["OPENCV", "OPENCV_FISHEYE", "EQUIRECTANGULAR"]
    assert cameras[1].params[:2] == pytest.approx([900, 900], rel=0.002)
    assert cameras[2].params[:2] == pytest.approx([400, 400], rel=0.002)
    assert cameras[2].params[2:4] == pytest.approx([505, 396], abs=2)
    assert cameras[3].params.tolist() == [1000.0, 500.0]
    assert 0.9 * before < found.model.compute_num_observations() <= 1.1 * before
    assert 0.2 < found.model.compute_mean_reprojection_error() < 0.5
    assert found.refined[3]["deviations"] == {} and found.refined[3]["determined"] == ()
    assert set(found.refined[2]["deviations"]) == {"fx", "fy", "cx", "cy", "k1", "k2", "k3", "k4"}
    lenses = found.lenses
    models = [lenses[key].chosen.model for key in (1, 2, 3)]
    assert models == ["SIMPLE_PINHOLE", "SIMPLE_FISHEYE", "EQUIRECTANGULAR"]
    assert lenses[1].to_dict()["file"] == "OPENCV" and not lenses[3].rivals
    for key in (1, 2):
        lost = [one.log_evidence for one in lenses[key].rivals]
        assert len(lost) >= 3 and lost == sorted(lost) and lost[0] > 0
    assert json_text({str(key): record.to_dict() for key, record in lenses.items()})


def test_other_families_are_not_tried_where_that_is_settled(mixed, monkeypatch):
    monkeypatch.setattr("sfm_app.colmap.bundle.best_families", None)
    found = adjust(*mixed, families_known=True)
    assert [found.model.cameras[key].model.name for key in (1, 2)] == ["OPENCV", "OPENCV_FISHEYE"]
    assert found.lenses[1].chosen.model == "SIMPLE_PINHOLE"
    with pytest.raises(TypeError):
        adjust(*mixed)


def test_panoramas_alone_are_adjusted_and_keep_their_camera(synthetic):
    model, database = synthetic(photos=6)
    rng = np.random.default_rng(1)
    seen_through(model, 1, camera_of(*PANORAMIC[:2], 1, PANORAMIC[2]), rng)
    for point_id in [key for key, point in model.points3D.items() if point.track.length() < 3]:
        model.delete_point3D(point_id)
    centers = {key: image.projection_center().copy() for key, image in model.images.items()}
    for point in model.points3D.values():
        point.xyz = point.xyz + rng.normal(scale=0.02, size=3)

    found = adjust(model, database)

    assert camera_family(found.model.cameras[1]) == PANORAMA and found.model.cameras[1].params.tolist() == [1000, 500]
    assert 0.2 < found.model.compute_mean_reprojection_error() < 0.5
    moved = [np.linalg.norm(found.model.images[key].projection_center() - center) for key, center in centers.items()]
    assert max(moved) < 0.1


@pytest.mark.parametrize("most", [250, 8])
def test_a_narrow_lens_taken_for_a_fisheye_becomes_perspective(mapped, monkeypatch, most):
    monkeypatch.setattr(bundle, "OPTIONS", bundle.AdjustmentOptions(most_compared=most))
    model, database = mapped(photos=16, start=(893.0, 500.0, 400.0, 0.0))
    before = model.num_reg_images()
    model.cameras[1].model = pycolmap.CameraModelId.OPENCV_FISHEYE
    model.cameras[1].params = [900.0, 900.0, 500.0, 400.0, 0.33, 0.1, 0.0, 0.0]

    found = adjust(model, database)

    assert 8 < found.model.num_reg_images() == before and found.model.cameras[1].model.name == "OPENCV"
    assert found.model.cameras[1].params[:2] == pytest.approx([900.0, 900.0], rel=0.005)
    assert 0.25 < found.model.compute_mean_reprojection_error() < 0.6
    assert any("FISHEYE" in one.model for one in found.lenses[1].rivals)


TRUE = [900.0, 900.0, 500.0, 400.0, -0.1, 0.02, 0.0, 0.0]


def given(params, model="OPENCV", *, keep):
    camera = calibration_from_model(model, params, SIZE)
    return CameraRule(given=replace(camera, method=KEPT) if keep else camera)


def test_a_kept_camera_stays_to_the_last_bit_and_its_photos_say_whether_it_is_right(mapped):
    model, database = mapped(TRUE, start=(893.0, 503.0, 396.0, 0.0))
    rule = given(TRUE, keep=True)
    found = adjust(model, database, {1: rule})
    camera = found.model.cameras[1]
    assert camera.model.name == "OPENCV" and camera.params.tolist() == TRUE
    assert 0.25 < found.model.compute_mean_reprojection_error() < 0.5
    assert found.refined[1]["deviations"] == {} and found.refined[1]["determined"] == () and found.held == ()
    assert found.estimates[1].focal_px == pytest.approx(900.0, rel=0.005)
    assert find_contradictions(rule.given, found.estimates[1]) == []


def test_a_given_camera_is_refined_and_contradicted_where_it_is_wrong(mapped):
    wrong = [970.0, 970.0, *TRUE[2:]]
    model, database = mapped(TRUE, start=(893.0, 503.0, 396.0, 0.0))
    rule = given(wrong, keep=False)
    found = adjust(model, database, {1: rule})
    assert found.model.cameras[1].params[:2] == pytest.approx([900.0, 900.0], rel=0.005)
    [said] = find_contradictions(rule.given, found.estimates[1])
    assert said.what == "focal length" and said.found_px == pytest.approx(900.0, rel=0.005)


def test_what_photos_do_not_determine_stays_as_it_was_given(mapped):
    """A rational term that no other camera has, and which a narrow view does not show."""
    true = [4500.0, 4500.0, 500.0, 400.0, -0.1, 0.02, 0.0, 0.0, 0.5, 0.0, 0.0, 0.0]
    model, database = mapped([*true[:4], 0, 0, 0, 0], start=(4480.0, 500.0, 400.0, 0.0))
    plain = read_camera(adjust(model, database).model.cameras[1])
    found = read_camera(adjust(model, database, {1: given(true, "FULL_OPENCV", keep=False)}).model.cameras[1])
    assert (plain[K3], found[K3]) == (0.0, 0.5) and abs(plain[K2]) < 0.01 < 0.015 < found[K2] < 0.025


@pytest.mark.parametrize(
    ("name", "free"), [("PINHOLE", ("aspect",)), ("RADIAL", ("k1", "k2")), ("OPENCV", ("aspect", "k1", "k2", "p1 p2"))]
)
def test_the_model_that_the_user_names_is_the_one_that_is_fitted(mapped, name, free):
    model, database = mapped([900.0, 903.0, *TRUE[2:6], 0.004, -0.004], start=(893.0, 500.0, 400.0, -0.08))
    found = adjust(model, database, {1: CameraRule(model=name)})
    chosen, params = found.lenses[1].chosen, read_camera(found.model.cameras[1])
    assert chosen.model == name and set(chosen.free) - {"center"} == set(free)
    assert (params[K1] != 0.0, params[K2] != 0.0, params[P1] != 0.0) == ("k1" in free, "k2" in free, "p1 p2" in free)
    assert (params[FX] != params[FX + 1]) == ("aspect" in free)
    assert params[FX] == pytest.approx(900.0, rel=0.06 if "k1" not in free else 0.006)


def test_a_perspective_lens_becomes_the_fisheye_that_the_user_names(mapped):
    model, database = mapped(TRUE, start=(893.0, 500.0, 400.0, -0.08))
    found = adjust(model, database, {1: CameraRule(model="RADIAL_FISHEYE")})
    camera = found.model.cameras[1]
    assert camera.model.name == "OPENCV_FISHEYE" and camera_family(camera) == FISHEYE
    assert found.lenses[1].chosen.model == "RADIAL_FISHEYE"
    assert 0.25 < found.model.compute_mean_reprojection_error() < 0.6
    assert camera.params[0] == pytest.approx(900.0, rel=0.01) and np.count_nonzero(camera.params[6:]) == 0


def away(model, share, place):
    """Put some points elsewhere."""
    keys = sorted(model.points3D)
    for key in keys[: max(1, int(share * len(keys)))]:
        model.points3D[key].xyz = place(model.points3D[key].xyz)
    return model


ASTRAY = {
    "a point at infinity": lambda model: away(model, 0, lambda xyz: 1e14 * xyz),
    "a point that is nowhere": lambda model: away(model, 0, lambda _: np.array([np.inf, np.nan, 0.0])),
    "a fifth of the points at infinity": lambda model: away(model, 0.2, lambda xyz: 1e13 * xyz),
    "a point in a camera": lambda model: away(model, 0, lambda _: model.images[1].projection_center()),
    "a fifth of the points in one place": lambda model: away(model, 0.2, lambda _: np.zeros(3)),
}


@pytest.mark.parametrize("case", ASTRAY)
def test_points_that_have_gone_astray_do_not_end_it_and_the_camera_is_found(mapped, case):
    model, database = mapped()
    found = adjust(ASTRAY[case](model), database)
    camera, deviations = found.model.cameras[1], found.refined[1]["deviations"]
    assert not found.failure and not found.held
    assert abs(camera.params[0] - 900) < 3 * deviations["fx"] and deviations["fx"] < 20
    assert found.model.num_points3D() > 250
    assert all(np.isfinite(point.xyz).all() for point in found.model.points3D.values())


def test_a_photo_that_no_pair_in_the_database_connects_stays_in_the_model(mapped):
    model, database = mapped(photos=6)
    with open_database(database) as known:
        for other in range(2, 7):
            known.delete_two_view_geometry(1, other)
    found = adjust(model, database)
    assert sorted(found.model.reg_image_ids()) == [1, 2, 3, 4, 5, 6]
    assert abs(found.model.cameras[1].params[0] - 900) < 3 * found.refined[1]["deviations"]["fx"]


def test_photos_from_one_place_leave_numbers_or_the_model_as_it_was(mapped):
    model, database = mapped()
    for image in model.images.values():
        pose = image.cam_from_world()
        pose.translation = pose.rotation.matrix() @ (model.images[1].cam_from_world().inverse().translation * -1.0)
        model.frames[image.frame_id].set_cam_from_world(image.camera_id, pose)
    found = adjust_or_keep(model, database)
    assert found.failure or found.refined[1]["deviations"]["fx"] > 1.0
    assert np.isfinite(found.model.cameras[1].params).all()
    assert all(np.isfinite(list(one["deviations"].values())).all() for one in found.refined.values())


def test_a_model_that_loses_its_points_stays_as_mapping_left_it(mapped):
    model, database = mapped()
    turn_photos(model)
    for point in model.points3D.values():
        point.xyz = np.random.default_rng(point.track.length()).normal(size=3)

    with pytest.raises(NumericalError, match=r"only \d+ of \d+ points remain"):
        adjust(model, database)
    found = adjust_or_keep(model, database)

    assert found.model is model and "points" in found.failure
    assert found.model.cameras[1].params.tolist() == [880.0, 500.0, 400.0, 0.0]
    assert found.refined == {1: {"deviations": {}, "determined": (), "correlations": {}}}


def test_a_camera_without_a_focal_length_stays_as_mapping_left_it(mapped):
    model, database = mapped(start=(np.nan, 500.0, 400.0, 0.0))
    found = adjust_or_keep(model, database)
    assert found.failure == "a camera has no focal length" and found.model is model
    assert find_cameras(model) == {}


@pytest.mark.parametrize(
    ("error", "expected"),
    [(np.linalg.LinAlgError("Singular matrix"), None), (ZeroDivisionError("division by zero"), None),
     (RuntimeError("out of memory"), BackendError)],
)  # fmt: skip
def test_what_fails_in_our_numbers_is_a_reason_and_what_fails_in_colmap_an_error(mapped, monkeypatch, error, expected):
    def failing(*_):
        raise error

    model, database = mapped()
    monkeypatch.setattr(bundle, "find_correspondences" if expected else "reduce", failing)
    if expected:
        with pytest.raises(expected, match=str(error)):
            adjust_or_keep(model, database)
    else:
        assert str(error) in adjust_or_keep(model, database).failure
