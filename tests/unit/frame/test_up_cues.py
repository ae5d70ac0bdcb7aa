"""Hypotheses of roll, cues of the scene, and the choice by their odds."""

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.synthetic.scenes import build_scene, scene_views
from sfm_app.frame.up_cues import (
    ROLL_OPTIONS,
    brightness_normal_correlation,
    depth_height_correlation,
    fit_surfaces,
    mean_upward_normal,
    roll_hypotheses,
    sky_asymmetry,
    slope_asymmetry,
)
from sfm_app.frame.up_direction import CUES, OPTIONS, Cue, Scenery, odds, select_roll
from sfm_app.synthetic.cameras import axis_rotation, look_at, pixel_rays
from sfm_app.synthetic.render import GAMMA, cast_rays, prepare, render_scene
from sfm_app.types.scene import camera_center

UP = np.array([0.0, 1.0, 0.0])
VIEW_AXIS = np.array([0.0, 0.0, 1.0])
UPRIGHT = [look_at(np.array([0, 0, 5.0]), np.zeros(3))[:, :3]]


def stripes(rows):
    """A picture (H, 120) with these gray levels, row by row, and a little texture."""
    texture = np.random.default_rng(0).normal(scale=1.0, size=(len(rows), 120))
    return np.clip(np.asarray(rows)[:, None] + texture, 0, 255).astype(np.uint8)


def ledge_rows(count=4):
    """Ledges from above: a lit top, a sharp border to the shadow under it, and slowly back to light."""
    return np.tile(np.linspace(60.0, 200.0, 40)[::-1], count)[::-1]


def terrain(light, seed=0):
    """Points (P, 3) of a bumpy ground, lit from a direction, of patchy color; seen from above."""
    rng = np.random.default_rng(seed)
    x, z = rng.uniform(-3, 3, (2, 4000))
    y = 0.4 * np.sin(3 * x) + 0.4 * np.cos(3 * z)
    normals = np.column_stack([-1.2 * np.cos(3 * x), np.ones_like(x), 1.2 * np.sin(3 * z)])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    color = rng.uniform(0.7, 1.3, len(x))
    return np.column_stack([x, y, z]), 120 * color * (1.0 + 0.8 * normals @ light)


def turned_by(turn_deg, rotations, scenery):
    """The same photos, turned counter-clockwise: they have to be turned back clockwise."""
    turn = axis_rotation(VIEW_AXIS, -turn_deg)
    pictures = tuple(None if p is None else np.ascontiguousarray(np.rot90(p, turn_deg // 90)) for p in scenery.pictures)
    return turn @ rotations, replace(scenery, pictures=pictures)


def scenery_of(points, photos):
    """Points that all photos see, all of one gray; no pictures."""
    return Scenery(points, np.full(len(points), 100.0), (np.arange(len(points)),) * photos, (None,) * photos)


def choose(rotations, centers, scenery):
    return select_roll(roll_hypotheses(rotations, centers), rotations, centers, scenery)


@pytest.fixture(scope="module", params=["corner", pytest.param("facade", marks=pytest.mark.slow)])
def rendered(request):
    """Six small photos of a rendered scene with y up, as rotations, centers and what they show."""
    scene, views = prepare(build_scene(request.param)), scene_views(request.param)
    rotations, centers, points, brightness, seen, pictures = [], [], [], [], [], []
    for name in sorted(views.cam_from_world)[::2][:6]:
        camera, pose = views.cameras[name], views.cam_from_world[name]
        shrink = 192 / camera.width
        K = np.diag([shrink, shrink, 1.0]) @ camera.K
        camera = replace(camera, K=K, width=192, height=round(shrink * camera.height))
        image = 255 * np.clip(render_scene(scene, camera, pose, supersampling=1), 0, 1) ** (1 / GAMMA)
        gray = image.mean(axis=2).astype(np.uint8)
        directions = pixel_rays(camera) @ pose[:, :3]
        depth = cast_rays(scene.rays, camera_center(pose), directions)["t_hit"].astype(np.float64)
        known = np.isfinite(depth) & (np.arange(depth.size) % 53 == 0)
        seen.append(np.arange(np.count_nonzero(known)) + sum(map(len, points)))
        points.append(camera_center(pose) + directions[known] * depth[known, None])
        brightness.append(gray.ravel()[known].astype(float))
        rotations.append(pose[:, :3])
        centers.append(camera_center(pose))
        pictures.append(gray)
    scenery = Scenery(np.concatenate(points), np.concatenate(brightness), tuple(seen), tuple(pictures))
    return np.array(rotations), np.array(centers), scenery


@pytest.mark.parametrize("turn_deg", [0, 180])
def test_rendered_photos_stand_upright_whichever_way_they_were_held(rendered, turn_deg):
    rotations, centers, scenery = rendered
    R, shown = turned_by(turn_deg, rotations, scenery)

    standing = choose(R, centers, shown)

    assert standing.roll.turn_deg == turn_deg
    assert standing.roll.up @ UP > np.cos(np.radians(20))
    # upside down, the habit of holding cameras upright speaks against what the scene shows
    habit = ROLL_OPTIONS.turn_costs[turn_deg // 90]
    assert standing.sign_log_odds == pytest.approx(
        sum(standing.evidence.values()) + ROLL_OPTIONS.turn_costs[2] - 2 * habit, abs=1e-6
    )
    assert 2 < min(standing.sign_log_odds, standing.axis_log_odds) < 20


@pytest.mark.parametrize("turn_deg", [90, 270])
def test_photos_on_their_side_of_a_walk_around_something(build_house, turn_deg):
    """The axis is plain from the walk; the floor tells which side is down."""
    house = build_house((1.0, -2.0, 0.5, 1.5, -1.0, 2.0), sweep_deg=120.0)
    floor = np.random.default_rng(3).uniform([-4, 0, -4], [4, 0, 4], (300, 3)) @ house.turned.T
    R, shown = turned_by(turn_deg, house.rotations, scenery_of(np.concatenate([house.points, floor]), 6))
    standing = choose(R, house.centers, shown)
    assert standing.roll.turn_deg == turn_deg
    assert standing.roll.up @ house.up > np.cos(np.radians(20))
    assert standing.evidence["tops are bright"] == standing.evidence["sky is above"] == 0.0


def test_no_single_cue_turns_photos_that_are_held_upright(build_house):
    """A ceiling and no floor: what is high is near, and nothing else is known."""
    house = build_house((1.0, -2.0, 0.5, 1.5, -1.0, 2.0))
    ceiling = np.random.default_rng(3).uniform([-4, 4, -4], [4, 4, 9], (900, 3)) @ house.turned.T

    standing = choose(house.rotations, house.centers, scenery_of(ceiling, 6))

    assert standing.roll.turn_deg == 0 and standing.roll.up @ house.up > 0.9
    assert (
        standing.evidence["low is near"] == -OPTIONS.max_nats
        and standing.evidence["tops are seen"] == -OPTIONS.max_nats
    )
    assert 0 <= standing.sign_log_odds < 0.1, "it is as likely as not, and says so"


def test_without_scenery_cameras_are_held_upright(build_house):
    house = build_house((1.0, -2.0, 0.5, 1.5), sweep_deg=90.0)
    standing = choose(house.rotations, house.centers, scenery_of(np.zeros((0, 3)), 4))
    assert standing.roll.turn_deg == 0 and not any(standing.evidence.values())
    assert standing.sign_log_odds == pytest.approx(ROLL_OPTIONS.turn_costs[2])


def test_opposite_turns_have_opposite_directions(build_house):
    house = build_house((1.0, 88.0, 0.5, 31.0, -1.0, 2.0))
    rolls = roll_hypotheses(house.rotations, house.centers)
    assert [roll.turn_deg for roll in rolls] == [0, 90, 180, 270]
    for roll, opposite in zip(rolls[:2], rolls[2:], strict=True):
        assert roll.up == pytest.approx(-opposite.up)


@pytest.mark.parametrize("turn_deg", [0, 90])
def test_three_steps_along_a_wall_are_level(build_house, turn_deg):
    """Nothing but the walk distinguishes the two verticals."""
    house = build_house((turn_deg + 1.0, turn_deg - 2.0, turn_deg + 0.5), sweep_deg=15.0, lines=(0, 0))
    standing = choose(house.rotations, house.centers, scenery_of(np.zeros((0, 3)), 3))
    assert abs(standing.roll.up @ house.up) > 0.98
    assert 0.2 < standing.axis_log_odds < 8


def test_ledges_are_lit_from_above():
    picture = stripes(ledge_rows())
    found = slope_asymmetry(UP, UPRIGHT, [picture])
    assert 0.4 < found < 1
    assert slope_asymmetry(-UP, UPRIGHT, [picture]) == pytest.approx(-found)
    assert slope_asymmetry(UP, UPRIGHT, [stripes(ledge_rows()[::-1])]) == pytest.approx(-found, abs=0.05)
    assert abs(slope_asymmetry(UP, UPRIGHT, [picture.T])) < 0.1
    assert slope_asymmetry(UP, UPRIGHT, [None]) == 0.0


def test_the_border_of_a_black_background_is_no_ledge():
    below = 80 + ledge_rows(3) / 3
    gray, black = (stripes(np.concatenate([np.full(60, level), below])) for level in (30.0, 0.0))
    assert slope_asymmetry(UP, UPRIGHT, [gray]) < -0.3 < 0.3 < slope_asymmetry(UP, UPRIGHT, [black])


def test_the_sky_is_even_and_bright():
    picture = stripes(np.repeat([200.0, 90.0], [40, 60]))
    picture[40:] = np.random.default_rng(1).integers(20, 160, picture[40:].shape)
    assert 0.7 < sky_asymmetry(UP, UPRIGHT, [picture]) <= 1
    assert sky_asymmetry(-UP, UPRIGHT, [picture]) == pytest.approx(-sky_asymmetry(UP, UPRIGHT, [picture]))
    assert sky_asymmetry(UP, UPRIGHT, [255 - picture]) < 0.1, "even and dark is a shadow"
    assert abs(sky_asymmetry(UP, UPRIGHT, [np.full((90, 120), 230, np.uint8)])) < 0.1, "and even all over is a wall"


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_light_from_above_and_from_below(side):
    points, brightness = terrain(side * UP)
    seen = [np.arange(len(points))], np.array([[0.0, 6.0, 0.0]])
    above = fit_surfaces(points, brightness, *seen)
    assert 0.15 < side * brightness_normal_correlation(UP, above) < 0.8
    assert brightness_normal_correlation(-UP, above) == pytest.approx(-brightness_normal_correlation(UP, above))
    assert 0.5 < mean_upward_normal(UP, above) < 0.9
    plain = fit_surfaces(points, np.full(len(points), 77.7), *seen)
    assert brightness_normal_correlation(UP, plain) == 0.0


def test_what_no_photo_sees_says_nothing():
    points, brightness = terrain(UP)
    unseen = fit_surfaces(points, brightness, [np.zeros(0, np.int64)], np.array([[0.0, 6.0, 0.0]]))
    assert len(unseen.normals) == 0
    assert mean_upward_normal(UP, unseen) == brightness_normal_correlation(UP, unseen) == 0.0


def test_low_is_near_on_the_ground_and_not_on_a_distant_thing():
    rng = np.random.default_rng(0)
    pose = look_at(np.array([0, 1.6, 8.0]), np.array([0, 1.0, 0]))
    places = pose[None, :, :3], camera_center(pose)[None]
    ground = rng.uniform([-4, 0, -9], [4, 0, 6], (500, 3))
    far = rng.uniform([-0.01, 0.99, -0.01], [0.01, 1.01, 0.01], (500, 3))
    tilted = far + 0.5 * np.outer(far[:, 1] - 1.0, [0, 0, -1])
    assert 0.5 < depth_height_correlation(UP, *places, ground, [np.arange(500)]) < 1
    assert 0 < depth_height_correlation(UP, *places, tilted, [np.arange(500)]) < 0.05
    assert depth_height_correlation(UP, *places, ground, [np.arange(5)]) == 0.0


def test_nats_grow_with_the_cue_and_with_the_points_and_end():
    cue = Cue(0.1, 0.1, noise=4.0)
    assert cue.nats(0.05, 10**9) == pytest.approx(1.0) and cue.nats(-0.05, 10**9) == pytest.approx(-1.0)
    assert 0.1 < cue.nats(0.05, 100) < 0.25
    assert cue.nats(5.0, 100) == OPTIONS.max_nats
    assert all(0 < CUES[name].mean < 0.5 and 0.05 < CUES[name].deviation < 0.5 for name in CUES)


def test_odds_are_rounded_and_end():
    assert (odds(0.0), odds(np.log(123.4))) == (1.0, 120.0)
    assert 1e6 < odds(np.inf) < 1.3e6
