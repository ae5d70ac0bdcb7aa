import numpy as np
import pytest

from sfm_app.synthetic.cameras import Camera, Lens, camera_center, look_at, make_camera
from sfm_app.synthetic.render import (
    comparison_image,
    orbited_pose,
    prepare_model,
    render_model,
    render_rays,
    render_shape,
)
from sfm_app.types import Surface
from sfm_app.types.model import Model, Texture

pytestmark = pytest.mark.slow

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
    picture = render_model(Model(square()), CAMERA, STRAIGHT)
    assert np.array_equal(picture.covered, np.arange(40)[None, :].repeat(20, axis=0) >= 20)
    share = (np.arange(20) + 0.5) / 20
    assert np.allclose(picture.colors[:, 20:, 0], np.round(250 * (1 - share))[:, None], atol=1)
    assert np.allclose(picture.colors[:, 20:, 2], np.round(250 * share)[:, None], atol=1)
    assert not picture.colors[:, :20].any() and np.all(picture.with_background((1, 2, 3))[:, :20] == [1, 2, 3])


@pytest.mark.parametrize("pages", [1, 3])
def test_a_page_of_the_size_of_its_pixels_is_shown_texel_by_texel(pages):
    """One texel per pixel: half a texel off, or an upside-down page, would be noticed."""
    page = np.random.default_rng(0).integers(0, 256, (20, 20, 3)).astype(np.uint8)
    picture = render_model(textured(page, pages=pages), CAMERA, STRAIGHT)
    assert np.abs(picture.colors[:, 20:].astype(int) - page).max() <= 2
    assert np.abs(picture.colors[:, 20:].astype(int) - np.roll(page, 1, axis=1)).mean() > 40


def test_texels_are_mixed_between_their_centers_and_repeated_at_the_border():
    page = np.zeros((1, 2, 3), np.uint8)
    page[0, 1] = 200
    row = render_model(textured(page), CAMERA, STRAIGHT).colors[10, 20:, 0].astype(float)
    expected = 200 * np.clip(2 * (np.arange(20) + 0.5) / 20 - 0.5, 0, 1)
    assert np.allclose(row, expected, atol=4), "the centers of the two texels lie at 1/4 and 3/4"


def test_the_lens_bends_the_picture():
    wide = Camera(np.array([[20.0, 0, 20.0], [0, 20.0, 10.0], [0, 0, 1]]), 40, 20, Lens(radial=(0.2,)))
    far = square(vertices=SQUARE * [0.8, 0.5, 1.0])
    plain, bent = (render_model(Model(far), camera, STRAIGHT).covered[10].sum() for camera in (CAMERA, wide))
    # x = 0.8 (1 + 0.2 0.64) = 0.902, in pixels 18.05 instead of 16
    assert (plain, bent) == (16, 18)


def test_any_rays_give_the_picture_of_their_camera():
    model = prepare_model(Model(square()))
    x, y = np.meshgrid(np.arange(40) + 0.5, np.arange(20) + 0.5)
    rays = np.stack([(x - 20) / 20, (y - 10) / 20, np.ones_like(x)], axis=-1)
    same = render_rays(model, np.zeros(3), 3.0 * rays)
    assert np.array_equal(same.colors, render_model(model, CAMERA, STRAIGHT).colors)


def test_the_bare_shape_is_gray_outside_and_reddish_inside():
    outside = render_shape(Model(square()), CAMERA, STRAIGHT)
    inside = render_shape(Model(square(FACES[:, ::-1])), CAMERA, STRAIGHT)
    assert np.array_equal(outside.covered, inside.covered)
    gray, red = outside.colors[outside.covered], inside.colors[inside.covered]
    assert np.all(gray[:, 0] == gray[:, 1]) and np.all(gray[:, 0] == gray[:, 2])
    assert np.all(red[:, 0].astype(int) > red[:, 1].astype(int) + 20)


def test_a_face_is_brighter_the_more_it_faces_the_lamp():
    """The lamp is above on the left: faces that look down and right are in the dark, but not black."""
    levels = []
    for tilt in (-0.5, 0.0, 0.5):
        tilted = SQUARE + np.array([0.0, 0.0, 1.0]) * (tilt * (SQUARE[:, :1] + SQUARE[:, 1:2]))
        picture = render_shape(Model(square(vertices=tilted)), CAMERA, STRAIGHT)
        levels.append(picture.colors[picture.covered].mean())
    assert 205 * 0.25 < levels[2] < levels[1] - 40 and levels[1] + 20 < levels[0] < 206


def test_a_model_without_triangles_is_not_seen():
    empty = Model(Surface(np.zeros((3, 3)), np.zeros((0, 3), np.int64), np.zeros((3, 3), np.uint8)))
    camera = make_camera(20, 16)
    for picture in (render_model(empty, camera, STRAIGHT), render_shape(empty, camera, STRAIGHT)):
        assert picture.colors.shape == (16, 20, 3) and not picture.covered.any()
        assert np.all(picture.with_background() == 255)


def test_beside_a_photo_stand_the_model_from_its_camera_from_aside_and_its_bare_shape():
    camera = Camera(np.array([[20.0, 0, 40.0], [0, 20.0, 20.0], [0, 0, 1]]), 80, 40)
    photo = np.full((80, 160, 3), (10, 200, 30), np.uint8)
    page = comparison_image(photo, textured(np.full((8, 8, 3), (200, 40, 30), np.uint8)), camera, STRAIGHT)
    views = {"photo": page[:40, :80], "model": page[:40, 80:], "aside": page[40:, :80], "shape": page[40:, 80:]}
    seen = {name: np.any(view != 255, axis=2) for name, view in views.items()}

    assert page.shape == (80, 160, 3) and page.dtype == np.uint8
    assert np.all(views["photo"] == [10, 200, 30])
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
    walked = orbited_pose(pose, surface, angle_deg)
    depth = np.median(surface.vertices @ pose[2, :3] + pose[2, 3])
    middle = pose[:, :3].T @ (np.array([0.0, 0.0, depth]) - pose[:, 3])

    assert walked[:, :3] @ middle + walked[:, 3] == pytest.approx([0.0, 0.0, depth])
    before, after = camera_center(pose) - middle, camera_center(walked) - middle
    assert after[1] == pytest.approx(before[1]) and np.linalg.norm(after) == pytest.approx(np.linalg.norm(before))
    turned = before[[0, 2]] @ after[[0, 2]] / np.linalg.norm(before[[0, 2]]) ** 2
    assert turned == pytest.approx(np.cos(np.radians(angle_deg)), abs=1e-9)
