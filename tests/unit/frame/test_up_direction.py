"""The up direction by lines, ground or roll, and the frame of viewers."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sfm_app.frame.up_direction import (
    CAMERAS,
    FLIGHT,
    GROUND,
    LINES,
    ROLL,
    WALL,
    Scenery,
    dominant_plane,
    flight_direction,
    up_direction,
    viewer_direction,
    viewer_frame,
)
from sfm_app.frame.vanishing_points import Segments, concatenate_segments, find_vanishing_direction
from sfm_app.geometry.poses import axis_angle_deg

HAND_HELD = (1.0, -2.0, 0.5, 1.5, -1.0, 2.0, -0.5, -1.5)


def error_deg(found, true):
    """Angle between directions, their sign included."""
    return float(np.degrees(np.arccos(np.clip(found @ true, -1, 1))))


def shown(scene, points=None):
    """Points that all photos see, without light; no pictures."""
    points, photos = scene.points if points is None else points, len(scene.rotations)
    return Scenery(points, np.full(len(points), 100.0), (np.arange(len(points)),) * photos, (None,) * photos)


def found_up(scene, segments=None, points=None, turn_deg=None):
    segments = scene.segments if segments is None else segments
    return up_direction(scene.rotations, scene.centers, shown(scene, points), segments, turn_deg)


@pytest.mark.parametrize("seed", [0, pytest.param(1, marks=pytest.mark.slow)])
def test_vertical_edges_say_where_up_is_better_than_the_cameras(build_house, seed):
    scene = build_house(HAND_HELD, aim_y=3.5, seed=seed)
    upright = found_up(scene)
    assert upright.method == LINES
    assert error_deg(upright.up, scene.up) < 0.1 < 0.3 < error_deg(upright.roll.up, scene.up) < 12
    assert upright.angle_to_roll_deg == pytest.approx(error_deg(upright.roll.up, upright.up), abs=1e-6)
    assert 0.001 < upright.deviation_deg < 0.2


def test_without_lines_it_is_the_direction_that_the_cameras_are_level_to(build_house):
    scene = build_house(HAND_HELD, sweep_deg=120.0)
    upright = found_up(scene, concatenate_segments([]))
    assert upright.method == ROLL
    assert error_deg(upright.up, scene.up) < 2 < upright.deviation_deg * 3
    assert 0.5 < upright.roll.spread_deg < 3


def test_clutter_does_not_pass_for_vertical_edges(build_house):
    scene = build_house(HAND_HELD, lines=(0, 0), clutter=400)
    assert found_up(scene).method == ROLL


@pytest.mark.slow
def test_a_set_that_is_turned_as_a_whole(build_house):
    upright_set = build_house(HAND_HELD, sweep_deg=90.0)
    turned = build_house([roll - 90 for roll in HAND_HELD], sweep_deg=90.0)
    found = found_up(turned)
    assert found_up(upright_set).roll.turn_deg == 0
    assert found.roll.turn_deg in (90, 270)
    assert axis_angle_deg(found.up, turned.up) < 0.2


def test_single_photos_that_are_turned_or_wild_are_outvoted(build_house):
    rolls = list(HAND_HELD)
    rolls[1] += 90
    rolls[4] += 35
    scene = build_house(rolls)
    upright = found_up(scene)
    assert error_deg(upright.up, scene.up) < 0.2
    assert error_deg(upright.roll.up, scene.up) < 4
    mean = np.mean([-R[1] for R in scene.rotations], axis=0)
    assert error_deg(mean / np.linalg.norm(mean), scene.up) > 10


@pytest.mark.parametrize("turn_deg", [90, -90])
def test_what_is_near_is_down(build_house, turn_deg):
    scene = build_house([roll + turn_deg for roll in HAND_HELD], sweep_deg=90.0)
    floor = np.random.default_rng(3).uniform([-4, 0, -4], [4, 0, 4], (300, 3)) @ scene.turned.T
    for ground, up in ((floor, scene.up), (floor + 4.0 * scene.up, -scene.up)):
        upright = found_up(scene, concatenate_segments([]), np.concatenate([scene.points, ground]))
        assert upright.method == ROLL  # a sure roll needs no ground
        assert error_deg(upright.up, up) < 8
        assert 3 < upright.sign_log_odds < 7


@pytest.mark.parametrize("turn_deg", [90, 180])
def test_who_knows_how_the_photos_are_turned_is_believed(build_house, turn_deg):
    scene = build_house(HAND_HELD, sweep_deg=90.0)
    upright = found_up(scene, turn_deg=turn_deg)
    assert upright.roll.turn_deg == turn_deg
    assert upright.sign_log_odds == upright.axis_log_odds == np.inf
    # what has to be turned clockwise to be upright has its top on the left
    top = {90: [-1, 0], 180: [0, 1]}[turn_deg]
    assert (scene.rotations @ upright.up)[:, :2].mean(axis=0) == pytest.approx(top, abs=0.15)


def test_cameras_that_nobody_held_level_stand_on_the_ground(build_house):
    scene = build_house([28, -24, 15, -31, 22, -12, 30, -26])
    rng = np.random.default_rng(3)
    floor = rng.uniform([-4, -0.01, -4], [4, 0.01, 4], (300, 3)) @ scene.turned.T
    standing = np.concatenate([scene.points, floor])
    upright = found_up(scene, concatenate_segments([]), standing)
    assert upright.method == GROUND
    assert error_deg(upright.up, scene.up) < 1


@pytest.mark.parametrize("level_deg", [20.0, pytest.param(-15.0, marks=pytest.mark.slow)])
def test_the_front_faces_the_viewer(build_house, level_deg):
    scene = build_house(HAND_HELD, level_deg=level_deg)
    upright = found_up(scene)
    towards, found_by = viewer_direction(upright, scene.rotations, scene.points)
    assert found_by == LINES
    assert error_deg(towards, scene.front) == pytest.approx(abs(level_deg), abs=0.3)
    assert abs(towards @ upright.up) < 1e-9


def test_a_view_across_a_corner_stays_one(build_house):
    scene = build_house(HAND_HELD, level_deg=44.0)
    towards, found_by = viewer_direction(found_up(scene), scene.rotations, scene.points)
    assert found_by == CAMERAS
    assert error_deg(towards, scene.front) < 6


def test_a_wall_of_points_is_a_front_too(build_house):
    scene = build_house(HAND_HELD)
    rng = np.random.default_rng(4)
    flat = rng.uniform([-3, 0, -0.01], [3, 3, 0.01], (300, 3))
    wall = flat @ np.array([[np.cos(0.2), 0, -np.sin(0.2)], [0, 1, 0], [np.sin(0.2), 0, np.cos(0.2)]]) @ scene.turned.T
    towards, found_by = viewer_direction(found_up(scene, concatenate_segments([])), scene.rotations, wall)
    assert found_by == WALL
    assert error_deg(towards, scene.front) == pytest.approx(np.degrees(0.2), abs=3)


def test_the_viewer_sees_the_scene_upright_centered_and_of_size_one(build_house):
    scene = build_house(HAND_HELD)
    seen = viewer_frame(scene.up, scene.front, scene.points)
    metric = viewer_frame(scene.up, scene.front, scene.points, meters=2.5)
    assert np.allclose(seen.R @ scene.up, [0, 1, 0]) and np.allclose(seen.R @ scene.front, [0, 0, 1])
    assert np.linalg.det(seen.R) == pytest.approx(1)
    assert np.allclose(np.median(scene.points @ seen.R.T * seen.scale + seen.t, axis=0), 0, atol=0.2)
    assert np.percentile(np.linalg.norm(seen(scene.points), axis=1), 80) == pytest.approx(1, abs=1e-6)
    assert metric.scale == 2.5


def test_neither_where_points_crowd_nor_far_ones_move_the_middle_of_the_scene():
    rng = np.random.default_rng(5)
    even, crowd = rng.uniform(-1, 1, (4000, 3)), rng.uniform([0.5, -1, -1], [1, 1, 1], (2500, 3))
    far = np.tile([400.0, 0.0, 0.0], (60, 1))
    seen = viewer_frame(np.array([0.0, 1, 0]), np.array([0.0, 0, 1]), np.concatenate([even, crowd, far]))
    middle = seen(np.zeros((1, 3)))[0] / seen.scale
    assert -0.25 < middle[0] < -0.1  # the median lies at 0.47
    assert np.abs(middle[1:]).max() < 0.05


def test_no_plane_where_points_fill_space():
    cloud = np.random.default_rng(0).normal(size=(2000, 3))
    assert dominant_plane(cloud, np.array([0.0, 1.0, 0.0]), (0.0, 20.0)) is None
    assert dominant_plane(cloud[:5], np.array([0.0, 1.0, 0.0]), (0.0, 90.0)) is None


def test_a_few_segments_are_no_direction(build_house):
    scene = build_house(HAND_HELD)
    few = Segments(*(column[:11] for column in scene.segments))
    assert find_vanishing_direction(scene.up, few) is None
    direction, deviation_deg = find_vanishing_direction(scene.up, scene.segments)
    assert abs(direction @ scene.up) > np.cos(np.radians(3.0 * deviation_deg)) and 0.001 < deviation_deg < 1.0


@pytest.mark.parametrize("seed", [0, 3, 12, 18])
def test_points_without_noise_give_a_plane_without_deviation(seed):
    rng = np.random.default_rng(seed)
    across, slope = rng.uniform(-3, 3, (60, 2)), rng.uniform(-0.1, 0.1, 2)
    points = np.column_stack([across[:, 0], 1.5 + across @ slope, across[:, 1]])
    normal, deviation_deg = dominant_plane(points, np.array([0.0, 1.0, 0.0]), (0.0, 20.0))
    assert 0.0 <= deviation_deg < 1e-6
    assert normal == pytest.approx(np.array([-slope[0], 1.0, -slope[1]]) / np.hypot(1.0, np.hypot(*slope)))


@pytest.mark.parametrize(
    "points", [np.zeros((0, 3)), np.zeros((40, 3)), np.linspace(0.0, 1.0, 40)[:, None] * [0.0, 1.0, 0.0]]
)
def test_no_points_one_place_and_a_line_have_no_plane(points):
    assert dominant_plane(points, np.array([0.0, 1.0, 0.0]), (0.0, 20.0)) is None


def survey(down, *, lines=3, photos=7, one_way=False, lean_deg=2.0, apart=0.4, ahead=0.0, seed=0):
    """Photos on a grid, 1 away from a rough plane that lies along `down`; photos of every second line are turned.

    Lines are `apart` from each other, and `ahead` of each other along the view.
    """
    rng = np.random.default_rng(seed)
    turned = Rotation.random(random_state=seed + 9).as_matrix()
    right = np.array([1.0, 0.0, 0.0])
    level = np.stack([right, np.cross(down, right), down])
    rotations, centers = [], []
    for line in range(lines):
        for k in range(photos):
            back = 180.0 if line % 2 and not one_way else 0.0
            lean = Rotation.from_euler("xyz", [*rng.normal(scale=lean_deg, size=2), back + rng.normal(scale=2.0)], True)
            rotations.append(lean.as_matrix() @ level @ turned.T)
            place = np.array([apart * line, 0.2 * k, ahead * line]) + rng.normal(scale=[0.02, 0.02, 0.01], size=3)
            centers.append(turned @ (level.T @ place))
    points = rng.uniform([-0.5, -0.5, 0.9], [1.5, 2.0, 1.05], (400, 3)) @ level @ turned.T
    return np.array(rotations), np.array(centers), points, turned


DOWN = np.array([0.0, -1.0, 0.0])


@pytest.mark.parametrize("one_way", [True, False])
@pytest.mark.parametrize("seed", [0, 1])
def test_photos_on_a_grid_that_look_one_way_are_a_map(one_way, seed):
    rotations, centers, points, turned = survey(DOWN, one_way=one_way, seed=seed)
    scenery = Scenery(points, np.full(len(points), 100.0), (np.arange(len(points)),) * len(centers), (None,) * 21)
    upright = up_direction(rotations, centers, scenery, concatenate_segments([]))
    assert upright.method == FLIGHT
    assert 5 < np.exp(upright.axis_log_odds) < 10 if one_way else np.exp(upright.axis_log_odds) > 10  # 10: no warning
    assert error_deg(upright.up, turned[:, 1]) < min(1.0, 4.0 * upright.deviation_deg)
    told = up_direction(rotations, centers, scenery, concatenate_segments([]), turn_deg=0)
    assert told.method == ROLL  # who knows that it is a wall is believed


def test_a_flight_with_a_round_of_oblique_photos():
    rotations, centers, points, turned = survey(DOWN)
    leaning = [Rotation.from_euler("x", angle, True).as_matrix() for angle in (35.0, 40.0, 45.0, 38.0)]
    oblique = np.array([lean @ R for lean, R in zip(leaning * 2, rotations[::3], strict=False)])
    found = flight_direction(np.concatenate([rotations, oblique]), np.concatenate([centers, centers[::3]]), points)
    assert found is not None and error_deg(found[0], turned[:, 1]) < 1.0


def test_what_is_no_flight():
    rotations, centers, points, _ = survey(DOWN)
    assert flight_direction(rotations, centers, points) is not None
    assert flight_direction(*survey(DOWN, lean_deg=25.0)[:3]) is None  # views of a thing from all sides
    assert flight_direction(*survey(DOWN, lines=1, photos=12)[:3]) is None  # a walk along a wall
    assert flight_direction(*survey(DOWN, lines=2, apart=0.1)[:3]) is None  # with the camera held high and low
    assert flight_direction(*survey(DOWN, apart=0.0, ahead=-0.4)[:3]) is None  # a crowd on a square
    assert flight_direction(rotations[:5], centers[:5], points) is None
    assert flight_direction(rotations, centers, centers - (points - centers.mean(axis=0))[: len(centers)]) is None
    mixed = centers + 0.2 * np.random.default_rng(0).normal(size=(21, 1)) * rotations[:, 2]  # near and far
    assert flight_direction(rotations, mixed, points) is None
