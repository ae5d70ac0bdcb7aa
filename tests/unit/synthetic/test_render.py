from dataclasses import replace

import numpy as np
import pytest

from sfm_app.synthetic.cameras import Camera, Lens, camera_center, look_at, make_camera, pixel_rays
from sfm_app.synthetic.render import cast_rays, prepare, ray_caster, render_scene
from sfm_app.synthetic.shapes import Body, Material, SyntheticScene, box

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def prepared(still_life):
    return prepare(still_life)


def test_two_views_show_the_same_surface_in_the_right_pixels(prepared, still_life, four_views):
    """What view 1 shows at a pixel, view 2 shows where the truth projects it to: half a pixel off would be noticed."""
    camera = make_camera(240, 160)
    poses = list(four_views.cam_from_world.values())[1:3]
    first, second = (render_scene(prepared, camera, pose, supersampling=3) for pose in poses)
    directions = pixel_rays(camera) @ poses[0][:, :3]
    caster = ray_caster(still_life.vertices, still_life.faces)
    hits = cast_rays(caster, camera_center(poses[0]), directions)
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


def test_a_pixel_is_seen_through_its_center():
    """A wall whose edges lie at x = 10.25 and 30.75, y = 4.25 and 15.75 pixels covers whole pixels by their centers."""
    white = Material(pattern="stone", base=(230, 230, 230), second=(230, 230, 230), joint=(230, 230, 230))
    wall = box(20.5, 11.5, 1.0, spacing=50.0).move((-4.5, -15.75 + 15.0, -20.5))
    scene = prepare(SyntheticScene("wall", (Body(wall, white),), to_light=(0.0, 0.0, 1.0)))
    camera = Camera(np.array([[20.0, 0, 25.0], [0, 20.0, 15.0], [0, 0, 1]]), 50, 30)
    pose = look_at(np.zeros(3), np.array([0.0, 0.0, -1.0]))  # the front of the wall is 20 units away

    image = render_scene(scene, camera, pose, supersampling=1)

    rows, columns = np.nonzero(image[..., 0] > image[..., 2])  # sunlight is warm, the sky is blue
    assert (columns.min(), columns.max(), rows.min(), rows.max()) == (10, 30, 4, 15)
    assert len(rows) == 21 * 12


def test_the_sun_casts_a_shadow_away_from_it(prepared, still_life):
    sun = np.array(still_life.to_light)
    ball = np.array([0.0, 1.3, 0.0])
    shaded = ball - sun * ball[1] / sun[1]  # where the shadow of the ball's middle falls
    above = look_at(np.array([0.0, 9.0, 0.1]), np.zeros(3))
    camera = make_camera(150, 150)
    empty = prepare(replace(still_life, bodies=still_life.bodies[:1]))
    ratio = (render_scene(prepared, camera, above) / render_scene(empty, camera, above)).mean(axis=2)

    def darkened(point):
        h = camera.K @ (above[:, :3] @ point + above[:, 3])
        x, y = (h[:2] / h[2]).astype(int)
        return ratio[y - 1 : y + 2, x - 1 : x + 2].mean()

    assert 0.15 < darkened(shaded) < 0.45, "the light of the sky is left"
    assert darkened(shaded * [-2, 1, -2]) == pytest.approx(1.0, abs=0.05)


def test_the_sky_is_blue_and_darker_above(prepared):
    up = look_at(np.array([0.0, 5.0, 0.0]), np.array([0.0, 9.0, 9.0]))
    sky = render_scene(prepared, make_camera(60, 60), up)
    assert np.all(sky[..., 2] > sky[..., 0])
    assert sky[0].mean() < 0.9 * sky[-1].mean()


def test_bodies_of_one_material_have_their_own_stains():
    white = Material(pattern="stone", base=(200, 200, 200), second=(100, 100, 100))
    twins = tuple(Body(box(1.0, 1.0, 1.0).move((x, 0.0, 0.0)), white) for x in (-0.5, 0.5))
    pose = look_at(np.array([0.0, 0.5, 9.0]), np.array([0.0, 0.5, 0.0]))
    camera = make_camera(200, 100, focal_widths=3.0, center=(0.5, 0.5))
    image = render_scene(prepare(SyntheticScene("twins", twins, to_light=(0.0, 0.0, 1.0))), camera, pose)[..., 1]
    left, right = image[30:70, 30:60], image[30:70, 101:131]  # one unit is 71 pixels
    assert left.std() > 0.01 and abs(np.corrcoef(left.ravel(), right.ravel())[0, 1]) < 0.5


def test_rows_are_seen_from_poses_of_their_own(prepared, four_views):
    """The upper half of a frame whose lower rows are seen from elsewhere is that of the photo from the first pose."""
    camera = make_camera(60, 40)
    first, second, *_ = four_views.cam_from_world.values()
    halves = np.concatenate([np.repeat(first[None], 20, axis=0), np.repeat(second[None], 20, axis=0)])

    image = render_scene(prepared, camera, halves)

    assert image[:20] == pytest.approx(render_scene(prepared, camera, first)[:20], abs=0.01)
    assert image[20:] == pytest.approx(render_scene(prepared, camera, second)[20:], abs=0.01)
    assert np.abs(image[20:] - render_scene(prepared, camera, first)[20:]).mean() > 0.02


def test_rendering_repeats_to_the_bit(prepared, four_views):
    pose = next(iter(four_views.cam_from_world.values()))
    camera = make_camera(60, 40)
    assert render_scene(prepared, camera, pose).tobytes() == render_scene(prepared, camera, pose).tobytes()


def test_distortion_moves_the_rim_but_not_the_center(prepared, four_views):
    pose = next(iter(four_views.cam_from_world.values()))
    plain = make_camera(120, 80, center=(0.5, 0.5))
    barrel = Camera(plain.K, 120, 80, lens=Lens(radial=(-0.4,)))
    difference = np.abs(render_scene(prepared, plain, pose) - render_scene(prepared, barrel, pose)).mean(axis=2)
    assert difference[38:42, 58:62].mean() < 0.3 * difference[:, :10].mean()
