"""Bearing vectors, undistortion, and the curve of a lens."""

import numpy as np
import pytest

from sfm_app.camera import bearings
from sfm_app.camera.models import calibration_from_model, camera_matrix, panorama_matrix
from sfm_app.camera.projection import OPTIONS, RAY, fold_radius, image_points, image_rays, lens_terms
from sfm_app.camera.rows import FISHEYE, K1, PERSPECTIVE
from sfm_app.geometry.epipolar import pixels_per_radian
from sfm_app.types import Calibration

K = np.array([[200.0, 0.0, 400.0], [0.0, 210.0, 300.0], [0.0, 0.0, 1.0]])
CAMERAS = {
    "perspective": Calibration(K, 800, 600, "test", True),
    "fisheye": Calibration(
        K, 800, 600, "test", True, projection="fisheye", distortion=(0.08, -0.01, 0.0, 0.0, 0.002, 0.0)
    ),
    "equirectangular": Calibration(K, 800, 600, "test", True, projection="equirectangular"),
}
PIXELS = np.random.default_rng(0).uniform([20.0, 20.0], [780.0, 580.0], (200, 2))
STEP = 1e-4


@pytest.mark.parametrize("name", CAMERAS)
def test_a_bearing_is_seen_at_its_pixel(name: str) -> None:
    lines = bearings.bearings(PIXELS, CAMERAS[name])
    for length in (0.1, 7.0):
        assert np.abs(bearings.project(length * lines[:, :3], CAMERAS[name]) - PIXELS).max() < 1e-9
        assert np.allclose(bearings.depths_along(length * lines[:, :3], CAMERAS[name]), length)


@pytest.mark.parametrize("name", CAMERAS)
def test_derivatives_agree_with_differences(name: str) -> None:
    lines = bearings.bearings(PIXELS, CAMERAS[name])
    for axis, columns in enumerate((slice(3, 6), slice(6, 9))):
        moved = bearings.bearings(PIXELS + STEP * np.eye(2)[axis], CAMERAS[name])
        assert np.abs((moved - lines)[:, :3] / STEP - lines[:, columns]).max() < 1e-6


def test_a_fisheye_looks_backwards() -> None:
    wide = Calibration(K, 800, 600, "test", True, projection="fisheye", distortion=(0.0,))
    behind = np.array([[np.sin(1.9), 0.0, np.cos(1.9)]])
    assert np.allclose(bearings.project(behind, wide), [[400.0 + 200.0 * 1.9, 300.0]])
    assert np.allclose(bearings.bearings(bearings.project(behind, wide), wide)[:, :3], behind)


def test_a_lens_that_folds_shows_nothing_beyond_its_fold() -> None:
    folding = Calibration(K, 800, 600, "test", True, projection="fisheye", distortion=(-0.2,))
    fold = fold_radius((-0.2, *[0.0] * 7), FISHEYE, OPTIONS.least_slope)
    assert 1.1 < fold < np.sqrt(1.0 / 0.6)
    for theta, seen in ((fold - 0.05, True), (fold + 0.05, False)):
        assert np.isfinite(bearings.project(np.array([[np.sin(theta), 0.0, np.cos(theta)]]), folding)).all() == seen


def test_a_perspective_camera_sees_nothing_behind_it_and_its_scale_is_its_mean_focal() -> None:
    assert np.isnan(bearings.project(np.array([[0.1, 0.2, -1.0]]), CAMERAS["perspective"])).all()
    assert pixels_per_radian(bearings.bearings(PIXELS, CAMERAS["perspective"])) == pytest.approx(205.0)


TERMS = np.array([-0.1, 0.02, 0.001, -0.002, 0.01, 0.02, -0.001, 0.001])


@pytest.mark.parametrize("family", [PERSPECTIVE, FISHEYE])
@pytest.mark.parametrize("shift", [0.0, 1.0])
def test_a_ray_comes_back_through_all_terms(family, shift):
    points = np.random.default_rng(0).uniform([-0.8, -0.8, 1.0], [0.8, 0.8, 1.2], (200, 3))
    terms = TERMS * [1.0, 1.0, shift, shift, 1.0, 1.0, *([shift] * 2 if family == FISHEYE else [1.0] * 2)]
    camera = np.array([1.0, 1.0, 0.0, 0.0, *terms])
    rays = image_rays(image_points(points, camera, family), camera, family)[:, :3]
    length = points[:, 2] if family == PERSPECTIVE else np.linalg.norm(points, axis=1)
    assert np.abs(rays - points / length[:, None]).max() < 1e-13


def test_points_beyond_the_fold_lie_on_it():
    camera = np.array([1.0, 1.0, 0.0, 0.0, -0.3, *[0.0] * 7])
    fold = fold_radius(lens_terms(camera), PERSPECTIVE, 0.0)
    assert fold == pytest.approx(np.sqrt(1.0 / 0.9))
    inside, beyond = image_rays(np.array([[0.5, 0.0], [5.0, 0.0]]), camera, PERSPECTIVE)[:, 0]
    assert 0.95 < beyond / fold < 1.0
    assert inside * (1.0 - 0.3 * inside**2) == pytest.approx(0.5)


@pytest.mark.parametrize("more", [0.0, 1e-9])
@pytest.mark.parametrize("family", [PERSPECTIVE, FISHEYE])
def test_a_fold_is_found_with_one_term_and_with_many(family, more):
    # the slope is 1 - 0.9 r^2
    assert fold_radius((-0.3, more, *[0.0] * 6), family, 0.1) == pytest.approx(1.0, abs=1e-7)
    assert fold_radius((0.3, more, *[0.0] * 6), family, 0.1) >= np.pi


SIZE = (1000, 800)
PANORAMA = Calibration(panorama_matrix((1000, 500)), 1000, 500, "panorama", True, projection="equirectangular")


def model(name, *params):
    return calibration_from_model(name, params, SIZE)


@pytest.mark.parametrize(
    "camera",
    [
        model("SIMPLE_PINHOLE", 500.0, 500.0, 400.0),
        model("SIMPLE_RADIAL", 500.0, 500.0, 400.0, -0.08),
        model("FULL_OPENCV", 500.0, 500.0, 500.0, 400.0, -0.1, 0.02, 0.0, 0.0, 0.001, 0.02, 0.0, 0.0),
        model("RADIAL_FISHEYE", 350.0, 500.0, 400.0, -0.02, 0.003),
    ],
)
def test_the_curve_is_that_of_the_rays(camera):
    x = np.column_stack([np.linspace(500.0, 990.0, 40), np.full(40, 400.0)])
    rays = bearings.bearings(x, camera)[:, RAY]
    radius = bearings.radius_px(np.arctan2(rays[:, 0], rays[:, 2]), camera)
    assert np.abs(radius - (x[:, 0] - 500.0)).max() < 1e-6


def test_a_lens_shows_nothing_behind_its_fold_or_behind_itself():
    barrel = model("SIMPLE_RADIAL", 500.0, 500.0, 400.0, -0.2)
    assert np.isnan(bearings.radius_px(np.array([1.5, 1.6, 2.0]), barrel)).all()
    assert np.isfinite(bearings.radius_px(np.array([2.0]), model("SIMPLE_FISHEYE", 200.0, 500.0, 400.0))).all()
    assert bearings.radius_px(np.array([np.pi]), PANORAMA) == pytest.approx([500.0])


def test_the_field_counts_what_the_lens_shows():
    assert bearings.field_of_view_deg(model("SIMPLE_PINHOLE", 500.0, 500.0, 400.0))[0] == pytest.approx(90.0)
    fisheye = model("SIMPLE_FISHEYE", 500.0 / np.radians(60.0), 500.0, 400.0)
    assert bearings.field_of_view_deg(fisheye) == pytest.approx((120.0, 96.0))
    assert bearings.field_of_view_deg(model("SIMPLE_RADIAL", 500.0, 500.0, 400.0, -0.1))[0] > 95.0
    assert bearings.field_of_view_deg(PANORAMA) == (360.0, 180.0)
    beside = Calibration(camera_matrix(500.0, 500.0, -100.0, 400.0), *SIZE, "given", True)
    assert bearings.field_of_view_deg(beside)[0] == pytest.approx(np.degrees(np.arctan(2.2) - np.arctan(0.2)))


def test_the_corner_is_the_farthest_one():
    assert bearings.corner_angle(model("SIMPLE_PINHOLE", 500.0, 500.0, 400.0)) == pytest.approx(
        np.arctan(np.hypot(1.0, 0.8))
    )
    assert bearings.corner_angle(model("SIMPLE_FISHEYE", 500.0, 0.0, 0.0)) == pytest.approx(np.hypot(2.0, 1.6))


def test_deviations_of_focal_and_k1_add_up():
    camera = Calibration(camera_matrix(500.0, 500.0, 500.0, 400.0), *SIZE, "x", True, spread={"fx": 5.0, "k1": 0.01})
    theta = np.array([np.pi / 4])
    assert bearings.radius_deviation_px(theta, camera) == pytest.approx([np.hypot(5.0, 5.0)])
    assert bearings.radius_deviation_px(theta, model("SIMPLE_PINHOLE", 500.0, 500.0, 400.0)) == pytest.approx([0.0])


RAY_CAMERA = np.array([900.0, 850.0, 480.0, 330.0, *[0.0] * 8])


@pytest.mark.parametrize("radial", [-0.3, -0.05, 0.0, 0.2, 1.5])
def test_rays_come_back_through_the_lens(radial):
    straight = np.random.default_rng(0).uniform(-0.55, 0.55, (200, 2))
    straight[0] = 0.0
    bent = straight * (1 + radial * (straight**2).sum(axis=1, keepdims=True))
    camera = RAY_CAMERA + radial * (np.arange(12) == K1)
    found = image_rays(bent * [900, 850] + [480, 330], camera, PERSPECTIVE)[:, :2]
    assert np.allclose(found, straight, atol=1e-10)
