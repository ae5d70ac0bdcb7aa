import numpy as np
import pytest

from sfm_app.synthetic.cameras import Camera, make_camera
from sfm_app.synthetic.pictures import prepare_model, render_model, render_shape, view_along
from sfm_app.types import Surface
from sfm_app.types.model import Model, Texture

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


def test_a_model_without_texture_has_the_colours_of_its_vertices():
    picture = render_model(Model(square()), CAMERA, STRAIGHT)
    assert np.array_equal(picture.covered, np.arange(40)[None, :].repeat(20, axis=0) >= 20)
    share = (np.arange(20) + 0.5) / 20
    assert np.allclose(picture.colors[:, 20:, 0], np.round(250 * (1 - share))[:, None], atol=1)
    assert np.allclose(picture.colors[:, 20:, 2], np.round(250 * share)[:, None], atol=1)
    assert not picture.colors[:, :20].any() and np.all(picture.on((1, 2, 3))[:, :20] == [1, 2, 3])


@pytest.mark.parametrize("pages", [1, 3])
def test_a_page_of_the_size_of_its_pixels_is_shown_texel_by_texel(pages):
    """One texel per pixel: half a texel off, or an upside-down page, would be noticed."""
    page = np.random.default_rng(0).integers(0, 256, (20, 20, 3)).astype(np.uint8)
    picture = render_model(textured(page, pages=pages), CAMERA, STRAIGHT)
    assert np.abs(picture.colors[:, 20:].astype(int) - page).max() <= 2
    assert np.abs(picture.colors[:, 20:].astype(int) - np.roll(page, 1, axis=1)).mean() > 40


def test_texels_are_mixed_between_their_centres_and_repeated_at_the_border():
    page = np.zeros((1, 2, 3), np.uint8)
    page[0, 1] = 200
    row = render_model(textured(page), CAMERA, STRAIGHT).colors[10, 20:, 0].astype(float)
    expected = 200 * np.clip(2 * (np.arange(20) + 0.5) / 20 - 0.5, 0, 1)
    assert np.allclose(row, expected, atol=4), "the centres of the two texels lie at 1/4 and 3/4"


def test_the_lens_bends_the_picture():
    wide = Camera(np.array([[20.0, 0, 20.0], [0, 20.0, 10.0], [0, 0, 1]]), 40, 20, radial=0.2)
    far = square(vertices=SQUARE * [0.8, 0.5, 1.0])
    plain, bent = (render_model(Model(far), camera, STRAIGHT).covered[10].sum() for camera in (CAMERA, wide))
    # x = 0.8 (1 + 0.2 0.64) = 0.902, in pixels 18.05 instead of 16
    assert (plain, bent) == (16, 18)


def test_any_rays_give_the_picture_of_their_camera():
    model = prepare_model(Model(square()))
    x, y = np.meshgrid(np.arange(40) + 0.5, np.arange(20) + 0.5)
    rays = np.stack([(x - 20) / 20, (y - 10) / 20, np.ones_like(x)], axis=-1)
    same = view_along(model, np.zeros(3), 3.0 * rays)
    assert np.array_equal(same.colors, render_model(model, CAMERA, STRAIGHT).colors)


def test_the_bare_shape_is_grey_outside_and_reddish_inside():
    outside = render_shape(Model(square()), CAMERA, STRAIGHT)
    inside = render_shape(Model(square(FACES[:, ::-1])), CAMERA, STRAIGHT)
    assert np.array_equal(outside.covered, inside.covered)
    grey, red = outside.colors[outside.covered], inside.colors[inside.covered]
    assert np.all(grey[:, 0] == grey[:, 1]) and np.all(grey[:, 0] == grey[:, 2])
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
        assert np.all(picture.on() == 255)
