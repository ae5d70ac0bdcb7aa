"""Folders with random problems."""

from collections import Counter
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from PIL import Image

from benchmarks.synthetic.trouble import (
    KINDS,
    PHOTOS,
    apply_motion_blur,
    cam_from_thing,
    equal_halves,
    mixed_cameras,
    moving_thing,
    troubled_folder,
    with_distortion,
    with_zoom,
    write_troubled_folder,
)
from sfm_app.synthetic.cameras import Views, make_camera, pixel_rays
from sfm_app.synthetic.shapes import Body
from sfm_app.types.scene import camera_center

pytestmark = pytest.mark.slow


@cache
def plans():
    """As they are asked for first: every worker collects this module, and one runs it."""
    return [troubled_folder(seed) for seed in range(60)]


def plan_with(*troubles):
    return next(plan for plan in plans() if set(troubles) <= set(plan.troubles))


def small(plan, photos=2, width=96):
    """The same folder with fewer and smaller photos, so that it is rendered at once."""
    names = sorted(plan.views.cameras)[:photos]
    cameras = {}
    for name in names:
        camera = plan.views.cameras[name]
        shrink = width / camera.width
        K = np.diag([shrink, shrink, 1.0]) @ camera.K
        cameras[name] = replace(camera, K=K, width=width, height=round(shrink * camera.height))
    return replace(plan, views=Views(cameras, {name: plan.views.cam_from_world[name] for name in names}))


def written(plan, folder):
    truth = write_troubled_folder(folder, plan)
    photos = {}
    for name in truth.cameras:
        with Image.open(folder / name) as image:
            photos[name] = np.asarray(image, dtype=np.float64)
    return photos


def test_every_trouble_comes_up_and_few_at_a_time():
    met = {kind for plan in plans() for kind in plan.troubles}
    assert met == set(KINDS)
    assert all(len(plan.troubles) <= 6 for plan in plans())
    assert 1 <= sum(not plan.troubles for plan in plans()) <= 6
    assert all(PHOTOS[0] <= len(plan.views.cameras) <= PHOTOS[1] for plan in plans())


def test_cameras_are_those_of_the_trouble():
    for plan in plans():
        focals = {round(camera.K[0, 0], 6) for camera in plan.views.cameras.values()}
        first = plan.views.cameras["view_00.jpg"]
        off = np.abs(first.K[:2, 2] / (first.width, first.height) - 0.5).max()
        assert (len(focals) > 2) == bool({"zoom", "mixed cameras"} & set(plan.troubles))
        assert (len(focals) == 1) == (not {"zoom", "mixed cameras", "two cameras"} & set(plan.troubles))
        assert (abs(first.K[1, 1] / first.K[0, 0] - 1) > 0.1) == ("squeeze" in plan.troubles)
        assert off > 0.03 or "crop" not in plan.troubles
        assert len({(camera.width, camera.height) for camera in plan.views.cameras.values()}) == 1
        pixel_rays(first)  # a lens that folds raises


def test_mixed_cameras_take_equally_many_photos_each():
    views = mixed_cameras(plan_with("orbit").views, 3, 0.3, np.random.default_rng(0))
    counts = Counter(camera.K[0, 0] for camera in views.cameras.values())
    assert len(counts) == 3 and max(counts.values()) - min(counts.values()) <= 1


@pytest.mark.parametrize(("trouble", "darkest", "brightest"), [("darkness", 0, 70), ("haze", 140, 255)])
def test_dark_and_hazy_photos_have_few_grays(trouble, darkest, brightest, tmp_path):
    for photo in written(small(plan_with(trouble), photos=1), tmp_path).values():
        assert photo.min() >= darkest and photo.max() <= brightest
        assert 0 < np.ptp(photo) < 70


def test_equal_halves_look_alike_after_half_a_turn():
    floor, *bodies = equal_halves(plan_with("orbit").scene).bodies
    for body in bodies:
        first, second = np.split(body.shape.vertices, 2)
        np.testing.assert_allclose(second, first * [-1.0, 1.0, -1.0], atol=1e-9)
        np.testing.assert_array_equal(*np.split(body.shape.texture, 2))
    assert len(np.unique(floor.shape.vertices, axis=0)) == len(floor.shape.vertices)


def test_a_lens_pushes_the_farthest_corner_by_what_is_asked_and_zooming_keeps_the_bend():
    camera = with_distortion(make_camera(640, 480, 1.0, center=(0.4, 0.55)), -0.08)
    corner = np.array([640.0, 0.0])
    seen = (corner - camera.K[:2, 2]) / camera.K[0, 0]
    assert camera.radial * (seen @ seen) == pytest.approx(-0.08)
    assert with_zoom(camera, 2.0).radial == pytest.approx(4 * camera.radial)
    assert with_zoom(camera, 2.0).K[1, 1] == 2 * camera.K[1, 1] and with_zoom(camera, 2.0).K[0, 2] == camera.K[0, 2]


def test_motion_blur_smears_along_its_direction_and_keeps_the_light():
    image = np.zeros((31, 31, 3))
    image[15, 15] = 1.0
    level = apply_motion_blur(image, 8.0, 0.0)[..., 0]
    rows, columns = np.mgrid[:31, :31] - 15
    assert level.sum() == pytest.approx(1.0)
    assert (level * columns**2).sum() == pytest.approx(8.0**2 / 12, rel=0.2)
    assert (level * rows**2).sum() == pytest.approx(0.0, abs=1e-9)
    assert np.array_equal(apply_motion_blur(image, 0.0, 1.0), image)


def test_what_moves_is_seen_elsewhere_and_the_rest_stays(tmp_path):
    plan = small(plan_with("moving object"), photos=1)
    name = "view_00.jpg"
    R, t = plan.views.cam_from_world[name][:, :3], plan.views.cam_from_world[name][:, 3]
    ahead = camera_center(plan.views.cam_from_world[name]) + 1.5 * R[2] - 0.4 * np.array([0.0, 1.0, 0.0])
    still = replace(plan, spoiling=replace(plan.spoiling, thing=None, blur_px={}, defocus_px={}))
    spoiling = replace(still.spoiling, thing=plan.spoiling.thing, thing_at={name: np.column_stack([np.eye(3), ahead])})
    moving = replace(plan, spoiling=spoiling)

    without, there = written(still, tmp_path / "a")[name], written(moving, tmp_path / "b")[name]

    changed = np.abs(without - there).max(axis=2) > 40
    assert 0.02 < changed.mean() < 0.8
    assert np.allclose(cam_from_thing(np.column_stack([R, t]), moving.spoiling.thing_at[name])[:, 3], R @ ahead + t)


def test_the_folder_is_rendered_alike_twice_and_a_thing_stands_on_its_foot(tmp_path):
    plan = small(plan_with("motion blur"))
    write_troubled_folder(tmp_path / "a", plan)
    write_troubled_folder(tmp_path / "b", plan)
    for path in (tmp_path / "a").iterdir():
        assert path.read_bytes() == (tmp_path / "b" / path.name).read_bytes()
    assert len(list((tmp_path / "a").iterdir())) == 2
    bodies = moving_thing(np.random.default_rng(1))
    assert all(isinstance(body, Body) for body in bodies) and min(b.shape.vertices[:, 1].min() for b in bodies) == 0.0
