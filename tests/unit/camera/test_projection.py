"""The projections are COLMAP's, and their derivatives those of differences."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sfm_app.bundle.normal_equations import REDUCTION, Bundle, apply_step, project, reduce, residuals
from sfm_app.camera.bearings import bearings
from sfm_app.camera.models import FAMILIES, PARAMETERS, calibration_from_model, row_of_calibration
from sfm_app.camera.projection import angle_limit, image_points, image_rays, project_points, radius_at
from sfm_app.camera.rows import CAMERA, FISHEYE, PANORAMA, PERSPECTIVE
from sfm_app.colmap.backend import pycolmap

BENT = (900.0, 950.0, 510.0, 390.0, -0.1, 0.05, 0.002, -0.003, 0.01, 0.02, -0.01, 0.005)
FULL = (400.0, 410.0, 510.0, 390.0, -0.02, 0.01, 0.002, -0.003, 0.004, -0.001, 0.003, -0.004)
ROUND = (1000 / (2 * np.pi), 500 / np.pi, 500.0, 250.0, *[0.0] * 8)
CAMERAS = {PERSPECTIVE: BENT, FISHEYE: FULL, PANORAMA: ROUND}
MODELS = {PERSPECTIVE: "FULL_OPENCV", FISHEYE: "THIN_PRISM_FISHEYE", PANORAMA: "EQUIRECTANGULAR"}


def points_of(family, count=60, seed=0):
    """In front of perspective cameras, up to 88 degrees off the axis of fisheyes, and all around panoramas."""
    rng = np.random.default_rng(seed)
    if family == PERSPECTIVE:
        return rng.uniform([-1, -1, 1.5], [1, 1, 5], (count, 3))
    found = rng.normal(size=(count, 3))
    found /= np.linalg.norm(found, axis=1)[:, None]
    if family == FISHEYE:
        found[:, 2] = np.abs(found[:, 2]) + 0.04
    return found * rng.uniform(0.5, 5, (count, 1))


def projected(points, params, family):
    rows = np.tile(params, (len(points), 1))
    return project_points(points, rows, np.full(len(points), family))


@pytest.mark.parametrize("family", CAMERAS)
def test_points_come_to_lie_where_colmap_puts_them(family):
    points = np.vstack([points_of(family), [[0.0, 0.0, 2.0], [1e-7, 0.0, 1.0]]])
    size = (1000, 500 if family == PANORAMA else 800)
    params = [*map(float, size)] if family == PANORAMA else list(CAMERAS[family])
    model = pycolmap.CameraModelId.__members__[MODELS[family]]
    camera = pycolmap.Camera(model=model, width=size[0], height=size[1], params=params)
    found = projected(points, CAMERAS[family], family).x
    assert found == pytest.approx(np.asarray(camera.img_from_cam(points)), abs=1e-6)


VALUES = {"f": 800.0, "fx": 800.0, "fy": 810.0, "cx": 510.0, "cy": 390.0, "k1": -0.05, "k2": 0.02, "p1": 1e-3}
VALUES |= {"p2": -2e-3, "k3": 0.004, "k4": -0.002, "k5": 0.01, "k6": 0.003, "sx1": 2e-3, "sy1": -1e-3, "w": 1000.0}


@pytest.mark.parametrize("name", PARAMETERS)
def test_pixels_and_rays_are_those_of_colmap(name):
    size = (1000, 500 if name == "EQUIRECTANGULAR" else 800)
    params = [(VALUES | {"h": 500.0})[key] for key in PARAMETERS[name]]
    truth = pycolmap.Camera(
        model=pycolmap.CameraModelId.__members__[name], width=size[0], height=size[1], params=params
    )
    camera = calibration_from_model(name, params, size)
    row, family = row_of_calibration(camera), FAMILIES[camera.projection]
    x = np.random.default_rng(3).uniform(0.0, size, (300, 2))
    rays = image_rays(x, row, family)[:, :3]
    expected = np.asarray(truth.cam_ray_from_img(x))
    assert rays / np.linalg.norm(rays, axis=1)[:, None] == pytest.approx(expected, abs=1e-9)
    assert image_points(expected, row, family) == pytest.approx(np.asarray(truth.img_from_cam(expected)), abs=1e-9)
    assert bearings(x, camera)[:, :3] == pytest.approx(rays, abs=1e-15)


def test_positions_without_derivatives_are_the_same_for_cameras_of_all_families():
    points = np.vstack([points_of(family) for family in CAMERAS])
    family = np.repeat(list(CAMERAS), 60)
    params = np.array([CAMERAS[kind] for kind in family])
    assert np.array_equal(image_points(points, params, family), project_points(points, params, family).x)
    for kind in CAMERAS:
        rows = family == kind
        alone = image_points(points[rows], params[rows], family[rows])
        assert np.array_equal(alone, project_points(points[rows], params[rows], family[rows]).x)


@pytest.mark.parametrize("family", CAMERAS)
def test_derivatives_by_camera_and_point_are_those_of_differences(family):
    points, params = points_of(family), np.array(CAMERAS[family])
    found, h = projected(points, params, family), 1e-6

    for place in range(CAMERA):
        off = h * np.eye(CAMERA)[place]
        difference = (projected(points, params + off, family).x - projected(points, params - off, family).x) / (2 * h)
        expected = np.zeros_like(difference) if family == PANORAMA else difference
        assert found.by_camera[:, :, place] == pytest.approx(expected, rel=1e-5, abs=1e-3)
    for axis in range(3):
        off = h * np.eye(3)[axis]
        difference = (projected(points + off, params, family).x - projected(points - off, params, family).x) / (2 * h)
        assert found.by_point[:, :, axis] == pytest.approx(difference, rel=1e-5, abs=1e-3)


def test_on_the_axis_of_a_fisheye_derivatives_are_finite_and_those_beside_it():
    near, beside = (projected(np.array([[x, x / 3, 2.0]]), FULL, FISHEYE) for x in (1e-9, 1e-3))
    for one, other in zip(near, beside, strict=True):
        assert np.isfinite(one).all() and one == pytest.approx(other, abs=0.7)


def mixed(photos=6, seed=0):
    """Two photos of each family see the same points between them."""
    rng = np.random.default_rng(seed)
    X = rng.uniform(-1, 1, (40, 3))
    R = Rotation.from_rotvec(rng.normal(scale=0.2, size=(photos, 3))).as_matrix()
    t = np.tile([0.0, 0.0, 4.0], (photos, 1))
    photo, point = (index.ravel() for index in np.indices((photos, len(X))))
    family = np.array([PERSPECTIVE, FISHEYE, PANORAMA])
    params = np.array([CAMERAS[kind] for kind in family])
    bundle = Bundle(params, np.arange(photos) % 3, R, t, X, photo, point, np.zeros((len(photo), 2)), family)
    return replace(bundle, x=project(bundle)[0] + rng.normal(scale=0.3, size=(len(photo), 2)))


def test_derivatives_by_pose_and_world_point_of_a_mixed_bundle_are_those_of_differences():
    bundle, h = mixed(), 1e-6
    _, _, by_pose, by_point = project(bundle)
    poses, points = np.zeros((len(bundle.R), 6)), np.zeros_like(bundle.X)

    for place in range(6):
        off = poses + h * np.eye(6)[place]
        ahead, behind = (project(apply_step(bundle, bundle.params, sign * off, points))[0] for sign in (1, -1))
        assert by_pose[:, :, place] == pytest.approx((ahead - behind) / (2 * h), rel=1e-5, abs=1e-3)
    for axis in range(3):
        off = points + h * np.eye(3)[axis]
        ahead, behind = (project(apply_step(bundle, bundle.params, poses, sign * off))[0] for sign in (1, -1))
        assert by_point[:, :, axis] == pytest.approx((ahead - behind) / (2 * h), rel=1e-5, abs=1e-3)


def test_a_panorama_has_nothing_free_and_its_neighbors_all():
    H = reduce(mixed(), 1.0).H
    assert np.abs(H[2 * CAMERA :]).max() <= REDUCTION.damping and np.abs(H[:, 2 * CAMERA :]).max() <= REDUCTION.damping
    assert np.all(np.diag(H)[: 2 * CAMERA] > 0)


def test_residuals_at_the_seam_of_a_panorama_go_the_short_way_round():
    bundle = mixed()
    one = bundle.camera[bundle.photo] == 2
    across = replace(bundle, x=bundle.x + np.where(one, 1000.0, 0.0)[:, None] * [1, 0])
    found = residuals(across, project(across)[0])
    assert found == pytest.approx(residuals(bundle, project(bundle)[0]), abs=1e-6)


@pytest.mark.parametrize(("k1", "reach", "folds"), [(-0.35, 0.6, False), (-0.35, 0.7, True), (0.2, 2.0, False)])
def test_a_perspective_lens_folds_where_its_radius_no_longer_grows(k1, reach, folds):
    # the radius r - 0.35 r^3 is largest at r = 0.976, where it is 0.651
    params = np.array([900.0, 900.0, 500.0, 400.0, k1, *[0.0] * 7])
    limit = angle_limit(params, PERSPECTIVE, reach)
    assert np.isnan(limit) == folds
    if not folds:
        assert radius_at(np.array([limit]), params, PERSPECTIVE)[0] == pytest.approx(reach, rel=0.1)


def test_a_fisheye_may_end_inside_the_photo_but_not_fold_there():
    straight, folding = (np.array([400.0, 400.0, 500.0, 400.0, k1, *[0.0] * 7]) for k1 in (-0.04, -0.3))
    assert angle_limit(straight, FISHEYE, 2.0) == pytest.approx(np.pi / 2)
    assert np.isnan(angle_limit(folding, FISHEYE, 2.0)) and 0.5 < angle_limit(folding, FISHEYE, 0.5) < 0.7
