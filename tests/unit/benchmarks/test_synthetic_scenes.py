"""Scenes are sound, their photos show them, and fine detail is as fine as it should be."""

from collections import Counter, defaultdict
from itertools import pairwise

import numpy as np
import pytest

from benchmarks.synthetic.detail_scenes import straight, tube
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
    town_views,
    walk_town,
)
from sfm_app.synthetic.cameras import Camera, make_camera, pixel_rays
from sfm_app.synthetic.render import cast_rays, ray_caster
from sfm_app.types.scene import camera_center
from tests.unit.synthetic.test_shapes import signed_volume


@pytest.mark.parametrize("name", ["courtyard", "heap"])
def test_scenes_are_sound_and_not_planar(name):
    scene = build_scene(name)
    vertices, faces = scene.vertices, scene.faces
    spread = np.linalg.svd(vertices - vertices.mean(axis=0), compute_uv=False)
    assert scene.name == name
    assert faces.min() == 0 and faces.max() == len(vertices) - 1
    assert np.isfinite(vertices).all() and 20_000 < len(vertices) < 200_000
    assert spread[2] / spread[0] > 0.2


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "sky", "near"),
    [("facade", (0.0, 0.65), 0.5), ("corner", (0.0, 0.65), 0.5), ("railing", (0.05, 0.6), 1.0)],
)  # fmt: skip
def test_photos_look_at_their_scene_from_outside_of_it_and_see_as_much_sky_as_they_should(name, sky, near):
    scene, views = build_scene(name), scene_views(name)
    caster = ray_caster(scene.vertices, scene.faces)
    assert scene.name == name and 12 <= len(views.cameras) <= 24
    for photo, pose in views.cam_from_world.items():
        camera = views.cameras[photo]
        assert max(camera.width, camera.height) == (1152 if near == 0.5 else 1800)
        coarse = Camera(np.diag([0.05, 0.05, 1.0]) @ camera.K, camera.width // 20, camera.height // 20)
        hits = cast_rays(caster, camera_center(pose), pixel_rays(coarse) @ pose[:, :3])["t_hit"]
        assert sky[0] <= np.mean(~np.isfinite(hits)) <= sky[1]
        assert hits.min() > near, "nobody stands in a wall or a tree"


SIZE = 4.0
"""Approximate size of these scenes."""


@pytest.mark.slow
@pytest.mark.parametrize("end", [(0.0, 2.0, 0.0), (1.0, 1.0, -1.0)])
def test_a_tube_is_closed_and_has_the_volume_of_a_cylinder(end):
    shape = tube(straight((0.0, 0.0, 0.0), end, 0.05), segments=48)
    assert signed_volume(shape) == pytest.approx(np.pi * 0.05**2 * np.linalg.norm(end), rel=0.01)
    edges = np.concatenate([shape.faces[:, [0, 1]], shape.faces[:, [1, 2]], shape.faces[:, [2, 0]]])
    assert {tuple(edge) for edge in edges} == {tuple(edge[::-1]) for edge in edges}
    assert np.linalg.norm(shape.normals, axis=1) == pytest.approx(1.0)


PLACES = [
    HousePlace(7, 8.0, (False, False), (40.0 * k, 0.0, 5.0 * k), turn, (k, 0)) for k, turn in enumerate((0.0, 90.0))
]


@pytest.fixture(scope="module")
def small_town():
    return build_scene("town")


def made(places, seed=3):
    return place_house(places, np.random.default_rng(seed))


def test_a_look_alike_is_the_same_house_in_every_place():
    for body, alone in zip(made(PLACES), made(PLACES[:1]), strict=True):
        first, second = np.split(np.arange(len(body.shape.vertices)), 2)
        assert np.array_equal(body.shape.texture[first], body.shape.texture[second])
        assert np.array_equal(body.shape.texture[first], alone.shape.texture) and body.material == alone.material
        x, y = (body.shape.vertices[rows] - place.to for rows, place in zip((first, second), PLACES, strict=True))
        assert np.allclose(y, x[:, [2, 1, 0]] * [1, 1, -1], atol=1e-9), "a quarter of a turn apart"


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


def test_a_smaller_set_is_the_beginning_of_the_walk():
    camera, options = make_camera(64, 48), TownPhotos(photos=300)
    whole, part = town_views(camera, options), town_views(camera, options, 20)
    names = list(part.cam_from_world)
    assert len(names) == 20 and names == list(whole.cam_from_world)[:20] and names[3] == "street_0003.jpg"
    for k, (name, pose) in enumerate(part.cam_from_world.items()):
        assert np.array_equal(pose, whole.cam_from_world[name])
        assert np.allclose(camera_center(pose), walk_town(300, options.step_m, 0).centers[k])


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
