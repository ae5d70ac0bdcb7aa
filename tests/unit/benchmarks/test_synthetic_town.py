"""A town of streets and houses, and walks through it."""

from collections import Counter, defaultdict
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from benchmarks.synthetic.houses import DEPTH_M
from benchmarks.synthetic.scenes import build_scene, scene_views
from benchmarks.synthetic.town import (
    BLOCK_M,
    COPIES,
    PITCH_M,
    STREET_M,
    HousePlace,
    TownPhotos,
    place_house,
    plan_houses,
    town,
    town_of,
    town_views,
    walk_town,
)
from sfm_app.errors import ConfigError
from sfm_app.synthetic import render
from sfm_app.synthetic.cameras import camera_center, look_at, make_camera, pixel_rays
from sfm_app.synthetic.render import cast_rays, prepare, ray_caster, render_scene
from sfm_app.synthetic.shapes import SyntheticScene

PLACES = [
    HousePlace(7, 8.0, (False, False), (40.0 * k, 0.0, 5.0 * k), turn, (k, 0)) for k, turn in enumerate((0.0, 90.0))
]


@pytest.fixture(scope="module")
def small_town():
    return build_scene("town")


def made(places, seed=3):
    return place_house(places, np.random.default_rng(seed))


def picture(body_list, place):
    """The front of a house, under the sky alone: the sun would come from another side of a turned house."""
    scene = replace(SyntheticScene("house", tuple(body_list)), sun=0.0, sky=1.0, bounced=0.3)
    out = np.array([np.sin(np.radians(place.turn_deg)), 0.0, np.cos(np.radians(place.turn_deg))])
    middle = np.add(place.to, (0.0, 3.0, 0.0))
    return render_scene(prepare(scene), make_camera(96, 72), look_at(middle + 11.0 * out, middle), 1)


def test_a_look_alike_is_the_same_house_in_every_place():
    for body, alone in zip(made(PLACES), made(PLACES[:1]), strict=True):
        first, second = np.split(np.arange(len(body.shape.vertices)), 2)
        assert np.array_equal(body.shape.texture[first], body.shape.texture[second])
        assert np.array_equal(body.shape.texture[first], alone.shape.texture) and body.material == alone.material
        x, y = (body.shape.vertices[rows] - place.to for rows, place in zip((first, second), PLACES, strict=True))
        assert np.allclose(y, x[:, [2, 1, 0]] * [1, 1, -1], atol=1e-9), "a quarter of a turn apart"


@pytest.mark.slow
def test_look_alikes_look_alike_and_other_houses_do_not():
    both = made(PLACES)
    first, second = (picture(both, place) for place in PLACES)
    assert np.median(np.abs(first - second)) < 1e-3 < 0.05 < first.std()
    other = picture(made(PLACES[:1], seed=4), PLACES[0])
    assert np.median(np.abs(first - other)) > 0.01


@pytest.mark.parametrize("share", [0.0, 0.1, 0.5])
def test_the_given_share_of_houses_stands_in_several_streets(share):
    places = plan_houses(3, share, seed=1)
    groups = defaultdict(list)
    for place in places:
        groups[place.model].append(place)
    alike = [group for group in groups.values() if len(group) > 1]
    assert abs(sum(map(len, alike)) - share * len(places)) <= 1
    for group in alike:
        assert 2 <= len(group) <= COPIES and len({(one.width, one.sides) for one in group}) == 1
        assert len({one.street for one in group}) == len(group)
    assert plan_houses(3, share, seed=1) == places != plan_houses(3, share, seed=2)


def test_houses_fill_the_sides_of_blocks_and_leave_the_streets_free():
    places = plan_houses(2, 0.1, seed=0)
    lengths = Counter()
    for place in places:
        turn = np.radians(place.turn_deg)
        along, back = np.array([np.cos(turn), -np.sin(turn)]), -np.array([np.sin(turn), np.cos(turn)])
        corners = [
            np.array(place.to)[[0, 2]] + x * along + z * back
            for x in (0.01 - place.width / 2, place.width / 2 - 0.01)
            for z in (0.01, DEPTH_M)
        ]
        inside = [(corner + STREET_M / 2) % PITCH_M for corner in corners]
        in_town = [np.all((corner > STREET_M / 2 - PITCH_M) & (corner < 2 * PITCH_M + BLOCK_M)) for corner in corners]
        if all(in_town):
            assert all((at > STREET_M).all() for at in inside)
            lengths[place.street] += place.width
    assert len(lengths) == 6 and min(lengths.values()) > 6 * (BLOCK_M - 2 * DEPTH_M)


@pytest.mark.parametrize("photos", [40, 1000])
def test_the_walk_keeps_to_the_streets(photos):
    walk = walk_town(photos, 1.2, seed=0)
    x, z = walk.centers[:, 0], walk.centers[:, 2]
    off = np.minimum(*(np.abs(value - PITCH_M * np.round(value / PITCH_M)) for value in (x, z)))
    assert off.max() < STREET_M / 2 - 3.5, "neither in a house nor in a parked car"
    assert min(x.min(), z.min()) > -4.0 and max(x.max(), z.max()) < PITCH_M * walk.blocks + 4.0


def test_a_long_walk_passes_places_again():
    walk = walk_town(1000, 1.2, seed=0)
    gaps = np.linalg.norm(walk.centers[:, None] - walk.centers[None], axis=2)
    far_in_time = np.abs(np.subtract.outer(np.arange(1000), np.arange(1000))) > 60
    assert ((gaps < 3.0) & far_in_time).any(axis=1).mean() > 0.2


def test_cameras_stand_upright():
    walk = walk_town(50, 1.2, seed=0)
    assert np.allclose(np.linalg.det(walk.rotations), 1.0)
    assert walk.rotations[:, 1, 1].max() < -0.9, "their y axis points down"
    assert np.allclose(
        walk.rotations[:, 2, [0, 2]] / np.cos(walk.pitch)[:, None], np.stack([np.sin(walk.yaw), np.cos(walk.yaw)], 1)
    )


def test_a_smaller_set_is_the_beginning_of_the_walk():
    camera, options = make_camera(64, 48), TownPhotos(photos=300)
    whole, part = town_views(camera, options), town_views(camera, options, 20)
    names = list(part.cam_from_world)
    assert len(names) == 20 and names == list(whole.cam_from_world)[:20] and names[3] == "street_0003.jpg"
    for k, (name, pose) in enumerate(part.cam_from_world.items()):
        assert np.array_equal(pose, whole.cam_from_world[name])
        assert np.allclose(camera_center(pose), walk_town(300, options.step_m, 0).centers[k])


@pytest.mark.slow
def test_the_same_seed_gives_the_same_town_which_is_as_large_as_the_walk(small_town):
    assert walk_town(40, 1.2, 5).blocks == 2 and walk_town(1000, 1.5, 4).blocks == 3
    first, again = town(2, 0.1, 5), town_of(TownPhotos(photos=40, look_alikes=0.1, seed=5))
    assert np.array_equal(first.vertices, again.vertices) and np.array_equal(first.faces, again.faces)
    assert [body.material for body in first.bodies] == [body.material for body in again.bodies]
    assert first.vertices.shape != small_town.vertices.shape


@pytest.mark.slow
def test_every_photo_sees_many_things_and_shares_them_with_the_next(small_town):
    views = scene_views("town")
    caster = ray_caster(small_town.vertices, small_town.faces)
    body_of = np.repeat(np.arange(len(small_town.bodies)), [len(body.shape.faces) for body in small_town.bodies])
    camera = make_camera(60, 45, focal_widths=0.8)
    seen = []
    for pose in views.cam_from_world.values():
        center, directions = camera_center(pose), pixel_rays(camera) @ pose[:, :3]
        hits = cast_rays(caster, center, directions)
        shows = np.isfinite(hits["t_hit"])
        depth = hits["t_hit"][shows]
        shares = np.bincount(body_of[hits["primitive_ids"][shows]]) / len(shows)
        assert shows.mean() > 0.4 and depth.min() > 0.2 and np.percentile(depth, 90) > 4.0
        assert np.count_nonzero(shares) > 25 and shares.max() < 0.6, "no wall fills a photo"
        seen.append((pose, center + depth[:, None] * directions[shows]))
    for (_, points), (pose, _) in pairwise(seen):
        x = (points @ pose[:, :3].T + pose[:, 3]) @ camera.K.T
        inside = (x[:, 2] > 0) & np.all((x[:, :2] > 0) & (x[:, :2] < x[:, 2:] * (camera.width, camera.height)), axis=1)
        assert inside.mean() > 0.25


@pytest.mark.slow
def test_photos_of_the_town_have_detail(small_town, monkeypatch):
    monkeypatch.setattr(render, "AMBIENT_RAYS", 1)
    prepared, poses = prepare(small_town), list(scene_views("town").cam_from_world.values())
    for k in (0, 13, 26):
        levels = np.clip(render_scene(prepared, make_camera(240, 180, focal_widths=0.8), poses[k], 1), 0, 1) ** 0.45
        steps = np.abs(np.diff(levels[..., 1], axis=1)).ravel()
        assert np.mean(steps > 0.03) > 0.25 and 0.15 < levels.mean() < 0.75


def test_impossible_towns_are_refused():
    with pytest.raises(ConfigError, match="photos, step_m or look_alikes"):
        TownPhotos(look_alikes=2.0)
    with pytest.raises(ConfigError, match="blocks or look_alikes"):
        town(0)
