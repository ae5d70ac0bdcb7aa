"""Photos of scenes, and pictures of models."""

from dataclasses import replace

import numpy as np
import pytest

from sfm_app.synthetic import render
from sfm_app.synthetic.cameras import Camera, look_at, make_camera, pixel_rays
from sfm_app.synthetic.shapes import Body, Material, SyntheticScene, box
from sfm_app.types import Surface
from sfm_app.types.scene import camera_center
from sfm_app.types.surface import Model, Texture

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def prepared(still_life):
    return render.prepare(still_life)


def test_two_views_show_the_same_surface_in_the_right_pixels(prepared, still_life, four_views):
    """What view 1 shows at a pixel, view 2 shows where the truth projects it to: half a pixel off would be noticed."""
    camera = make_camera(240, 160)
    poses = list(four_views.cam_from_world.values())[1:3]
    first, second = (render.render_scene(prepared, camera, pose, supersampling=3) for pose in poses)
    directions = pixel_rays(camera) @ poses[0][:, :3]
    caster = render.ray_caster(still_life.vertices, still_life.faces)
    hits = render.cast_rays(caster, camera_center(poses[0]), directions)
    hit = np.isfinite(hits["t_hit"])
    points = camera_center(poses[0]) + directions[hit] * hits["t_hit"][hit, None]
    h = (points @ poses[1][:, :3].T + poses[1][:, 3]) @ camera.K.T
    x2 = h[:, :2] / h[:, 2:] - 0.5  # to array indices, pixel centers being at +0.5

    def mismatch(dx, dy):
        shifted = x2 + np.array([dx, dy])
        at = np.floor(shifted).astype(int)
        inside = ((at >= 2) & (at < [camera.width - 3, camera.height - 3])).all(axis=1)
        rest = (shifted - at)[inside]
        (u, v), (i, j) = rest.T[..., None], at[inside].T
        low = second[j, i] * (1 - u) + second[j, i + 1] * u
        high = second[j + 1, i] * (1 - u) + second[j + 1, i + 1] * u
        return np.median(np.abs(low * (1 - v) + high * v - first.reshape(-1, 3)[hit][inside]))

    best = mismatch(0.0, 0.0)
    assert 0 < best < 0.03
    assert all(mismatch(dx, dy) > 1.2 * best for dx, dy in [(0.5, 0), (-0.5, 0), (0, 0.5), (0, -0.5)])


@pytest.mark.parametrize("shine", [0.0, 0.6])
def test_only_what_metal_reflects_moves_with_the_camera(shine):
    gray = Material(
        pattern="stone", base=(150,) * 3, second=(150,) * 3, joint=(150,) * 3, contrast=0.0, shine=shine
    )  # fmt: skip
    scene = render.prepare(SyntheticScene("wall", (Body(box(4.0, 4.0, 0.2), gray),), to_light=(0.2, 0.3, 1.0)))
    middle, camera = np.array([0.0, 2.0, 0.1]), make_camera(41, 31)
    centers = np.array([[0.0, 2.0, 3.0], [1.5, 2.0, 2.5], [-2.0, 3.0, 2.0]])
    colors = [render.render_scene(scene, camera, look_at(center, middle), 1)[15, 20] for center in centers]

    change = np.ptp(colors, axis=0) / np.mean(colors, axis=0)
    assert np.all(change > 0.1) if shine else np.all(change < 1e-6)
    assert np.all(np.mean(colors, axis=0) > 0.05)


def test_a_pixel_is_seen_through_its_center():
    """A wall whose edges lie at x = 10.25 and 30.75, y = 4.25 and 15.75 pixels covers whole pixels by their centers."""
    white = Material(pattern="stone", base=(230, 230, 230), second=(230, 230, 230), joint=(230, 230, 230))
    wall = box(20.5, 11.5, 1.0, spacing=50.0).move((-4.5, -15.75 + 15.0, -20.5))
    scene = render.prepare(SyntheticScene("wall", (Body(wall, white),), to_light=(0.0, 0.0, 1.0)))
    camera = Camera(np.array([[20.0, 0, 25.0], [0, 20.0, 15.0], [0, 0, 1]]), 50, 30)
    pose = look_at(np.zeros(3), np.array([0.0, 0.0, -1.0]))  # the front of the wall is 20 units away
    image = render.render_scene(scene, camera, pose, supersampling=1)
    rows, columns = np.nonzero(image[..., 0] > image[..., 2])  # sunlight is warm, the sky is blue
    assert (columns.min(), columns.max(), rows.min(), rows.max()) == (10, 30, 4, 15) and len(rows) == 21 * 12


def test_the_sun_casts_a_shadow_away_from_it(prepared, still_life):
    sun = np.array(still_life.to_light)
    ball = np.array([0.0, 1.3, 0.0])
    shaded = ball - sun * ball[1] / sun[1]  # where the shadow of the ball's middle falls
    above = look_at(np.array([0.0, 9.0, 0.1]), np.zeros(3))
    camera = make_camera(150, 150)
    empty = render.prepare(replace(still_life, bodies=still_life.bodies[:1]))
    ratio = (render.render_scene(prepared, camera, above) / render.render_scene(empty, camera, above)).mean(axis=2)

    def darkened(point):
        h = camera.K @ (above[:, :3] @ point + above[:, 3])
        x, y = (h[:2] / h[2]).astype(int)
        return ratio[y - 1 : y + 2, x - 1 : x + 2].mean()

    assert 0.15 < darkened(shaded) < 0.45, "the light of the sky is left"
    assert darkened(shaded * [-2, 1, -2]) == pytest.approx(1.0, abs=0.05)


def test_rows_are_seen_from_poses_of_their_own(prepared, four_views):
    """The upper half of a frame whose lower rows are seen from elsewhere is that of the photo from the first pose."""
    camera = make_camera(60, 40)
    first, second, *_ = four_views.cam_from_world.values()
    halves = np.concatenate([np.repeat(first[None], 20, axis=0), np.repeat(second[None], 20, axis=0)])
    image = render.render_scene(prepared, camera, halves)
    assert image[:20] == pytest.approx(render.render_scene(prepared, camera, first)[:20], abs=0.01)
    assert image[20:] == pytest.approx(render.render_scene(prepared, camera, second)[20:], abs=0.01)
    assert np.abs(image[20:] - render.render_scene(prepared, camera, first)[20:]).mean() > 0.02


CAMERA = Camera(np.array([[20.0, 0, 20.0], [0, 20.0, 10.0], [0, 0, 1]]), 40, 20)
STRAIGHT = np.eye(3, 4)
SQUARE = np.array([[0.0, -0.5, 1.0], [1.0, -0.5, 1.0], [1.0, 0.5, 1.0], [0.0, 0.5, 1.0]])
"""The right half of the picture, one unit in front."""
FACES = np.array([[0, 3, 2], [0, 2, 1]])
"""Counter-clockwise seen from the camera at the origin."""
CORNER_UV = np.array([[0.0, 0], [1, 0], [1, 1], [0, 1]], np.float32)
RED_TO_BLUE = np.array([[250, 0, 0], [250, 0, 0], [0, 0, 250], [0, 0, 250]], np.uint8)


def square(faces=FACES, vertices=SQUARE):
    return Surface(vertices, faces, RED_TO_BLUE)


def textured(page, *, pages=1):
    uv = CORNER_UV[FACES]
    return Model(square(), Texture(uv, np.full(2, pages - 1, np.int32), (np.zeros_like(page),) * (pages - 1) + (page,)))


def test_a_model_without_texture_has_the_colors_of_its_vertices():
    picture = render.render_model(render.PreparedModel(Model(square())), CAMERA, STRAIGHT)
    assert np.array_equal(picture.covered, np.arange(40)[None, :].repeat(20, axis=0) >= 20)
    share = (np.arange(20) + 0.5) / 20
    assert np.allclose(picture.colors[:, 20:, 0], np.round(250 * (1 - share))[:, None], atol=1)
    assert np.allclose(picture.colors[:, 20:, 2], np.round(250 * share)[:, None], atol=1)
    assert not picture.colors[:, :20].any() and np.all(picture.with_background((1, 2, 3))[:, :20] == [1, 2, 3])


@pytest.mark.parametrize("pages", [1, 3])
def test_a_page_of_the_size_of_its_pixels_is_shown_texel_by_texel(pages):
    """One texel per pixel: half a texel off, or an upside-down page, would be noticed."""
    page = np.random.default_rng(0).integers(0, 256, (20, 20, 3)).astype(np.uint8)
    picture = render.render_model(render.PreparedModel(textured(page, pages=pages)), CAMERA, STRAIGHT)
    assert np.abs(picture.colors[:, 20:].astype(int) - page).max() <= 2
    assert np.abs(picture.colors[:, 20:].astype(int) - np.roll(page, 1, axis=1)).mean() > 40


def test_a_model_without_triangles_is_not_visible():
    points = render.PreparedModel(Model(square(np.zeros((0, 3), np.int64))))
    for picture in (render.render_model(points, CAMERA, STRAIGHT), render.render_shape(points, CAMERA, STRAIGHT)):
        assert picture.colors.shape == (20, 40, 3) and not picture.covered.any() and not picture.colors.any()


def test_the_bare_shape_is_gray_outside_and_reddish_inside():
    outside = render.render_shape(render.PreparedModel(Model(square())), CAMERA, STRAIGHT)
    inside = render.render_shape(render.PreparedModel(Model(square(FACES[:, ::-1]))), CAMERA, STRAIGHT)
    assert np.array_equal(outside.covered, inside.covered)
    gray, red = outside.colors[outside.covered], inside.colors[inside.covered]
    assert np.all(gray[:, 0] == gray[:, 1]) and np.all(gray[:, 0] == gray[:, 2])
    assert np.all(red[:, 0].astype(int) > red[:, 1].astype(int) + 20)


def test_beside_a_photo_stand_the_model_from_its_camera_from_aside_and_its_bare_shape():
    camera = Camera(np.array([[20.0, 0, 40.0], [0, 20.0, 20.0], [0, 0, 1]]), 80, 40)
    photo = np.full((80, 160, 3), (10, 200, 30), np.uint8)
    page = render.comparison_image(
        photo, render.PreparedModel(textured(np.full((8, 8, 3), (200, 40, 30), np.uint8))), camera, STRAIGHT
    )
    views = {"photo": page[:40, :80], "model": page[:40, 80:], "aside": page[40:, :80], "shape": page[40:, 80:]}
    seen = {name: np.any(view != 255, axis=2) for name, view in views.items()}

    assert page.shape == (80, 160, 3) and page.dtype == np.uint8 and np.all(views["photo"] == [10, 200, 30])
    assert np.all(views["model"][10:30, 40:60] == [200, 40, 30]) and seen["model"].sum() == 20 * 20
    # its right edge has come nearer: 20 cos 25 / (1 - sin 25) = 31 px from the left one, and 35 px high instead of 20
    assert 700 < np.all(views["aside"] == [200, 40, 30], axis=2).sum() <= seen["aside"].sum() < 950
    assert np.array_equal(seen["aside"], seen["shape"])
    inner = views["shape"][np.all(views["aside"] == [200, 40, 30], axis=2)]
    assert np.ptp(inner, axis=1).max() == 0 and 50 < inner.min() <= inner.max() < 206


@pytest.mark.parametrize("angle_deg", [25.0, -90.0])
def test_walking_around_keeps_height_distance_and_what_is_in_the_middle(angle_deg):
    surface = Surface(np.random.default_rng(0).normal(size=(99, 3)), FACES, RED_TO_BLUE)
    pose = look_at(np.array([1.0, 2.0, 6.0]), np.zeros(3))
    walked = render.orbited_pose(pose, surface, angle_deg)
    depth = np.median(surface.vertices @ pose[2, :3] + pose[2, 3])
    middle = pose[:, :3].T @ (np.array([0.0, 0.0, depth]) - pose[:, 3])
    assert walked[:, :3] @ middle + walked[:, 3] == pytest.approx([0.0, 0.0, depth])
    before, after = camera_center(pose) - middle, camera_center(walked) - middle
    assert after[1] == pytest.approx(before[1]) and np.linalg.norm(after) == pytest.approx(np.linalg.norm(before))
    turned = before[[0, 2]] @ after[[0, 2]] / np.linalg.norm(before[[0, 2]]) ** 2
    assert turned == pytest.approx(np.cos(np.radians(angle_deg)), abs=1e-9)
