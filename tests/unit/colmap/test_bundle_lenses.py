"""The last adjustment of cameras of every family, and the camera models that it chooses."""

import numpy as np
import pytest

from sfm_app.camera.projection import CAMERA, CX, CY, FX, FY, PANORAMA
from sfm_app.colmap import bundle
from sfm_app.colmap.backend import pycolmap
from sfm_app.colmap.bundle import adjust, camera_family, file_model, read_camera, solve, write_camera
from sfm_app.numerical import json_text

WIDTH, HEIGHT = 1000, 800


def camera_of(model, params, camera_id=1, size=(WIDTH, HEIGHT)):
    kind = pycolmap.CameraModelId.__members__[model]
    return pycolmap.Camera(camera_id=camera_id, model=kind, width=size[0], height=size[1], params=params)


PANORAMIC = ("EQUIRECTANGULAR", [1000.0, 500.0], (1000, 500))
CAMERAS = [
    ("SIMPLE_RADIAL", [900.0, 510.0, 390.0, -0.1], (WIDTH, HEIGHT)),
    ("OPENCV", [900.0, 910.0, 510.0, 390.0, -0.1, 0.02, 0.001, -0.002], (WIDTH, HEIGHT)),
    ("FULL_OPENCV", [900.0, 910.0, 510.0, 390.0, -0.1, 0.02, 0.001, -0.002, 0.01, 0.02, -0.01, 0.01], (WIDTH, HEIGHT)),
    ("OPENCV_FISHEYE", [400.0, 410.0, 510.0, 390.0, -0.02, 0.01, -0.001, 0.002], (WIDTH, HEIGHT)),
    ("THIN_PRISM_FISHEYE", [400.0, 400.0, 510.0, 390.0, -0.02, 0.01, 0.001, -0.002, 0.01, 0.02, 0.001, -0.001],
     (WIDTH, HEIGHT)),
    PANORAMIC,
]  # fmt: skip


@pytest.mark.parametrize(("model", "params", "size"), CAMERAS)
def test_a_camera_is_the_same_after_a_round_trip_in_the_smallest_model_that_holds_it(model, params, size):
    camera, other = camera_of(model, params, size=size), camera_of(model, params, size=size)
    points = np.random.default_rng(0).uniform([-1, -1, 1], [1, 1, 3], (20, 3))

    write_camera(other, read_camera(camera), camera_family(camera))

    assert other.model.name == ("OPENCV" if model == "SIMPLE_RADIAL" else model)
    assert np.asarray(other.img_from_cam(points)) == pytest.approx(np.asarray(camera.img_from_cam(points)), abs=1e-9)


def test_zeros_make_the_model_smaller():
    params = np.zeros(CAMERA)
    params[[FX, FY, CX, CY]] = 900.0, 900.0, 500.0, 400.0

    assert [file_model(params, family) for family in (0, 1)] == ["OPENCV", "OPENCV_FISHEYE"]
    assert [file_model(params + np.eye(CAMERA)[8], family) for family in (0, 1)] == ["FULL_OPENCV", "OPENCV_FISHEYE"]
    assert [file_model(params + np.eye(CAMERA)[6], family) for family in (0, 1)] == ["OPENCV", "THIN_PRISM_FISHEYE"]


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


@pytest.mark.slow
def test_cameras_of_three_families_are_adjusted_together(mixed):
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
    assert found.deviations[3] == {} and found.determined[3] == ()
    assert set(found.deviations[2]) == {"fx", "fy", "cx", "cy", "k1", "k2", "k3", "k4"}


@pytest.mark.slow
def test_the_model_of_every_camera_is_named_with_its_rivals(mixed):
    lenses = adjust(*mixed).lenses

    assert [lenses[key].chosen.model for key in (1, 2, 3)] == [
        "SIMPLE_PINHOLE", "SIMPLE_FISHEYE", "EQUIRECTANGULAR"
    ]  # fmt: skip
    assert lenses[1].to_dict()["file"] == "OPENCV" and not lenses[3].rivals
    for key in (1, 2):
        lost = [one.log_evidence for one in lenses[key].rivals]
        assert len(lost) >= 3 and lost == sorted(lost) and lost[0] > 0
    assert json_text({str(key): record.to_dict() for key, record in lenses.items()})


@pytest.mark.slow
def test_other_families_are_not_tried_where_that_is_settled(mixed, monkeypatch):
    monkeypatch.setattr("sfm_app.colmap.bundle.best_families", None)

    found = adjust(*mixed, families_known=True)

    assert [found.model.cameras[key].model.name for key in (1, 2)] == ["OPENCV", "OPENCV_FISHEYE"]
    assert found.lenses[1].chosen.model == "SIMPLE_PINHOLE"
    with pytest.raises(TypeError):
        adjust(*mixed)


@pytest.mark.slow
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


@pytest.mark.slow
def test_colmap_moves_poses_and_points_of_a_model_of_three_families(mixed):
    model, _ = mixed
    model.cameras[1].params = [900.0, 500.0, 400.0, 0.0]
    model.cameras[2].params = [400.0, 400.0, 505.0, 396.0, 0.0, 0.0, 0.0, 0.0]
    for point in model.points3D.values():
        point.xyz = point.xyz + 0.01

    solve(model)

    model.update_point_3d_errors()
    assert 0.2 < model.compute_mean_reprojection_error() < 0.5


@pytest.mark.slow
@pytest.mark.parametrize("most", [250, 8])
def test_a_narrow_lens_taken_for_a_fisheye_becomes_perspective(mapped, monkeypatch, most):
    monkeypatch.setattr(bundle, "OPTIONS", bundle.AdjustmentOptions(most_compared=most))
    model, database = mapped(
        [900.0, 900.0, 500.0, 400.0, 0.0, 0.0, 0.0, 0.0], photos=16, start=(893.0, 500.0, 400.0, 0.0)
    )
    before = model.num_reg_images()
    camera = model.cameras[1]
    camera.model = pycolmap.CameraModelId.OPENCV_FISHEYE
    camera.params = [900.0, 900.0, 500.0, 400.0, 0.33, 0.1, 0.0, 0.0]

    found = adjust(model, database)

    assert 8 < found.model.num_reg_images() == before
    assert found.model.cameras[1].model.name == "OPENCV"
    assert found.model.cameras[1].params[:2] == pytest.approx([900.0, 900.0], rel=0.005)
    assert 0.25 < found.model.compute_mean_reprojection_error() < 0.6
    assert any("FISHEYE" in one.model for one in found.lenses[1].rivals)
