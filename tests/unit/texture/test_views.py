"""Views for texturing: projection through all lenses, sizes, sampling, panoramas."""

import numpy as np
import pytest
from painted_box import around

from sfm_app.camera.projection import project_points
from sfm_app.camera.rows import FISHEYE, PERSPECTIVE
from sfm_app.errors import ReconstructionError
from sfm_app.photos.panoramas import panorama_parts
from sfm_app.stages.texture import photo_views
from sfm_app.texture.views import part_view, photo_view, project, sample
from sfm_app.types import CameraModel, Scene

SIZE = 640, 480
LENSES = {
    "OPENCV": ((400.0, 410.0, 322.0, 238.0, -0.1, 0.02, 1e-3, -2e-3), PERSPECTIVE),
    "FULL_OPENCV": ((400.0, 410.0, 322.0, 238.0, 0.3, 0.1, 1e-3, -2e-3, 0.05, 0.5, 0.2, 0.01), PERSPECTIVE),
    "OPENCV_FISHEYE": ((250.0, 255.0, 322.0, 238.0, 0.02, -0.004, 1e-3, -1e-4), FISHEYE),
    "THIN_PRISM_FISHEYE": ((250.0, 255.0, 322.0, 238.0, 0.02, -4e-3, 2e-3, 1e-3, 1e-3, -1e-4, 2e-3, 1e-3), FISHEYE),
}
PLACES = {"OPENCV": range(8), "FULL_OPENCV": range(12), "OPENCV_FISHEYE": (0, 1, 2, 3, 4, 5, 8, 9),
          "THIN_PRISM_FISHEYE": range(12)}  # fmt: skip


@pytest.mark.parametrize("model", LENSES)
def test_projection_is_that_of_bundle_adjustment(model):
    params, family = LENSES[model]
    full = np.zeros(12)
    full[list(PLACES[model])] = params
    pixels = np.random.default_rng(0).uniform(-0.8, 0.8, (200, 2))
    points = np.column_stack([pixels, np.ones(200)]) * np.linspace(0.5, 9.0, 200)[:, None]
    R = np.linalg.qr(np.random.default_rng(1).normal(size=(3, 3)))[0]
    R *= np.sign(np.linalg.det(R))
    pose = np.column_stack([R, [0.1, -0.2, 0.3]])

    view = photo_view("a.jpg", CameraModel(model, params, np.eye(3), *SIZE), pose)
    row = view.row
    found = np.array([project(row, *((point - pose[:, 3]) @ R)) for point in points])

    expected = project_points(points, np.tile(full, (200, 1)), np.full(200, family)).x
    np.testing.assert_allclose(found[:, :2], expected, atol=1e-8)
    assert (found[:, 2] > 0.0).all()
    half = view.resize(SIZE[0] // 2, SIZE[1] // 2)
    smaller = np.array([project(half.row, *((point - pose[:, 3]) @ R)) for point in points])
    np.testing.assert_allclose(2.0 * smaller[:, :2], expected, atol=1e-8)
    behind = np.array([1e-3, 0.0, -1.0]) - pose[:, 3]
    assert project(row, *(behind @ R)) == (0.0, 0.0, 0.0)


def test_a_fisheye_shows_its_side_and_nothing_beyond_its_corner():
    params = (180.0, 180.0, 320.0, 240.0, 0.0, 0.0, 0.0, 0.0)  # the corner is at 127 degrees
    row = photo_view("a", CameraModel("OPENCV_FISHEYE", params, np.eye(3), *SIZE), np.eye(3, 4)).row

    u, v, distance = project(row, 1.0, 0.0, 1e-3)
    assert (u, v) == pytest.approx((320.0 + 180.0 * (np.pi / 2 - 1e-3), 240.0), abs=1e-3) and distance > 0.9
    assert project(row, 1.0, 0.0, -0.5)[2] == 0.0
    assert project(row, 0.0, 0.0, -1.0)[2] == 0.0
    assert project(row, 0.0, 0.0, 1.0)[:2] == (320.0, 240.0)


def test_a_lens_shows_nothing_beyond_its_fold():
    params = (300.0, 300.0, 320.0, 240.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0)  # r / (1 + r^2) folds at r = 1
    row = photo_view("a", CameraModel("FULL_OPENCV", params, np.eye(3), *SIZE), np.eye(3, 4)).row

    assert project(row, 0.9, 0.0, 1.0) == pytest.approx((320.0 + 300.0 * 0.9 / 1.81, 240.0, 1.0))
    assert project(row, 1.1, 0.0, 1.0)[2] == 0.0


def test_views_cover_a_whole_panorama():
    pose = np.column_stack([np.diag([-1.0, 1.0, -1.0]), [0.5, 0.0, 0.0]])
    panorama = CameraModel("EQUIRECTANGULAR", (640.0, 320.0), np.eye(3), 640, 320)
    scene = Scene(None, {"sub/a.jpg": pose}, {}, {"c": panorama}, 1, 1, 0.1, {"sub/a.jpg": "c"})

    views = photo_views(scene)

    assert [view.photo for view in views] == ["sub/a.jpg"] * 6 and len({view.name for view in views}) == 6
    for view in views:
        np.testing.assert_allclose(view.center, -pose[:, :3].T @ pose[:, 3], atol=1e-12)
    X = np.random.default_rng(0).normal(size=(500, 3)) * 4.0
    depths = np.zeros(500)
    for view in views:
        u, v, depth = np.array([project(view.row, *point) for point in X]).T
        inside = (depth > 0) & (u > 0) & (u < view.width) & (v > 0) & (v < view.height)
        depths[inside] = depth[inside]
    assert (depths > 0.0).all()


def test_a_part_view_has_the_rays_of_its_part():
    part = panorama_parts((640, 320))[1]
    view = part_view("a.2", "a", part, np.eye(3, 4))

    u, v, _ = project(view.row, *(part.rays()[30, 40] * 5.0))

    assert (u, v) == pytest.approx((40.5, 30.5), abs=1e-9) and view.photo == "a"


def test_other_camera_models_are_refused():
    camera = CameraModel("FISHEYE", (1.0,) * 8, np.eye(3), 10, 10)
    with pytest.raises(ReconstructionError, match="texturing does not support the camera model FISHEYE"):
        photo_view("a", camera, np.eye(3, 4))


def test_sampling_is_linear_between_pixel_centers():
    y, x = np.mgrid[:5, :7]
    photo = np.stack([10 * x, 20 * y, x + y], axis=2).astype(np.uint8)
    assert sample(photo, 2.75, 3.25, 0) == pytest.approx(22.5)
    assert sample(photo, 2.75, 3.25, 1) == pytest.approx(55.0)
    assert sample(photo, -4.0, 99.0, 0) == 0.0


@pytest.mark.parametrize("k1", [-0.2, 0.0, 0.1])
def test_the_widest_angle_bounds_the_visible_rays(k1):
    view = around(1, k1=k1)[0]
    rays = np.random.default_rng(0).normal(size=(4000, 3))
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    inside = [
        angle
        for ray, angle in zip(rays, np.arccos(rays @ view.axis), strict=True)
        for u, v, depth in [project(view.row, *(view.center + ray))]
        if depth > 0 and 0 <= u <= view.width and 0 <= v <= view.height
    ]
    assert max(inside) <= view.widest_angle < max(inside) + np.radians(8)
