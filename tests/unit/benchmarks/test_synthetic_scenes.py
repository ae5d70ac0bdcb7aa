"""Scenes are sound, their photos show them, and fine detail is as fine as it should be."""

import numpy as np
import pytest

from benchmarks.synthetic.detail_scenes import HIGH, WIDTH, carving, pebbles, relief, ridge, straight, tree, tube
from benchmarks.synthetic.scenes import PLASTER, SCENES, WALKS, build_scene, corner, scene_views
from sfm_app.errors import ConfigError
from sfm_app.synthetic.cameras import Camera, camera_center, make_camera, pixel_rays
from sfm_app.synthetic.render import GAMMA, cast_rays, prepare, ray_caster, render_scene
from tests.unit.synthetic.test_shapes import signed_volume


@pytest.mark.slow
def test_a_poster_is_flat_and_all_scenes_have_their_names():
    assert np.ptp(build_scene("poster").vertices[:, 2]) < 0.2
    assert [build_scene(name).name for name in SCENES] == list(SCENES)


@pytest.mark.parametrize("name", ["courtyard", "heap"])
def test_scenes_are_sound_and_not_planar(name):
    scene = build_scene(name)
    vertices, faces = scene.vertices, scene.faces
    spread = np.linalg.svd(vertices - vertices.mean(axis=0), compute_uv=False)

    assert scene.name == name
    assert faces.min() == 0 and faces.max() == len(vertices) - 1
    assert np.isfinite(vertices).all() and 20_000 < len(vertices) < 200_000
    assert spread[2] / spread[0] > 0.2


def test_unknown_scenes_are_refused():
    with pytest.raises(ConfigError, match="atlantis") as caught:
        build_scene("atlantis")
    assert "courtyard" in caught.value.hint


@pytest.mark.slow
@pytest.mark.parametrize("name", ["statue", "facade", "corner"])
def test_photos_look_at_their_scene_from_outside_of_it(name):
    scene, views = build_scene(name), scene_views(name)
    caster = ray_caster(scene.vertices, scene.faces)
    assert scene.name == name and 12 <= len(views.cameras) <= 24
    for photo, pose in views.cam_from_world.items():
        camera = views.cameras[photo]
        assert 1000 <= max(camera.width, camera.height) <= 1200
        coarse = type(camera)(np.diag([0.05, 0.05, 1.0]) @ camera.K, camera.width // 20, camera.height // 20)
        hits = cast_rays(caster, camera_center(pose), pixel_rays(coarse) @ pose[:, :3])
        depth = hits["t_hit"][np.isfinite(hits["t_hit"])]
        assert 0.35 < np.isfinite(hits["t_hit"]).mean() <= 1.0, "the scene fills a good part of every photo"
        assert depth.min() > 0.5, "nobody stands in a wall"


@pytest.mark.slow
def test_the_statue_is_seen_all_round_and_the_facade_from_the_street():
    eyes = np.array([camera_center(pose) for pose in scene_views("statue").cam_from_world.values()])
    around = np.sort(np.degrees(np.arctan2(eyes[:, 0], eyes[:, 2])))
    assert max(np.diff(around).max(), 360 - np.ptp(around)) < 25
    along = np.array([camera_center(pose) for pose in scene_views("facade").cam_from_world.values()])
    assert np.ptp(along[:, 0]) > 7 and along[:, 2].min() > 5 and np.all(np.diff(along[:, 0]) > 0)


@pytest.mark.slow
def test_the_plain_wall_is_plain_but_not_even():
    """Gray levels that differ by about the noise of a photo, where the paper on the other wall differs by far more."""
    scene = corner()
    prepared, pose = prepare(scene), next(iter(scene_views("corner").cam_from_world.values()))
    camera = make_camera(288, 192, focal_widths=0.9)
    levels = 255 * np.clip(render_scene(prepared, camera, pose, supersampling=1), 0, 1) ** (1 / GAMMA)
    hits = cast_rays(prepared.rays, camera_center(pose), pixel_rays(camera) @ pose[:, :3])
    seen = np.isfinite(hits["t_hit"])
    body = np.full(seen.shape, -1)
    body[seen] = prepared.face_material[hits["primitive_ids"][seen]]
    fine = (levels[:, 1:, 1] - levels[:, :-1, 1]).reshape(-1)
    same = (body.reshape(192, 288)[:, 1:] == body.reshape(192, 288)[:, :-1]).reshape(-1)
    of = body.reshape(192, 288)[:, 1:].reshape(-1)
    plain = next(k for k, one in enumerate(scene.bodies) if one.material == PLASTER)
    steps = {k: np.median(np.abs(fine[same & (of == k)])) for k in (plain, plain + 1)}
    assert 0.05 < steps[plain] < 1.5 < 3.0 < steps[plain + 1]


@pytest.mark.slow
def test_walks_are_of_known_scenes():
    assert set(WALKS) == {"courtyard", "statue", "facade", "corner", "town", "ornament", "railing", "garden"}
    with pytest.raises(ConfigError, match="poster") as caught:
        scene_views("poster")
    assert "statue" in caught.value.hint


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


@pytest.mark.slow
def test_a_bent_tube_keeps_its_radius():
    angle = np.linspace(0.0, 4.0, 80)
    line = np.column_stack([np.cos(angle), np.sin(angle), 0.2 * angle, np.full(80, 0.03)])

    rings = tube(line, segments=12).vertices[:-2].reshape(80, 12, 3)

    assert np.linalg.norm(rings - line[:, None, :3], axis=2) == pytest.approx(0.03)
    assert np.linalg.norm(np.diff(rings, axis=0), axis=2).max() < 0.09, "it is not twisted"


@pytest.mark.slow
def test_a_relief_has_the_asked_height_and_normals():
    shape = relief(lambda x, y: 0.1 * np.sin(3.0 * x) * y, 2.0, 1.0, 0.01)

    x, y, z = shape.vertices.T
    assert z == pytest.approx(0.1 * np.sin(3.0 * x) * y)
    slope = np.column_stack([-0.3 * np.cos(3.0 * x) * y, -0.1 * np.sin(3.0 * x), np.ones_like(x)])
    assert shape.normals == pytest.approx(slope / np.linalg.norm(slope, axis=1)[:, None], abs=0.01)
    corners = shape.vertices[shape.faces]
    assert np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])[:, 2].min() > 0


@pytest.mark.slow
def test_a_ridge_ends_at_half_its_width():
    assert ridge(np.array([0.0, 0.25, 0.5, 2.0]), 1.0) == pytest.approx([1.0, np.sqrt(0.75), 0.0, 0.0])


@pytest.mark.slow
def test_pebbles_are_as_large_as_asked_and_lie_everywhere():
    x, y = np.meshgrid(np.linspace(-0.5, 0.5, 201), np.linspace(0.0, 1.0, 201), indexing="ij")
    height = pebbles(x, y, (0.01, 0.03), 0.025, seed=1)

    assert height.min() >= 0.0 and 0.01 < height.max() < 0.8 * 0.03
    assert 0.75 < np.mean(height > 0) < 1.0
    assert np.array_equal(height, pebbles(x, y, (0.01, 0.03), 0.025, seed=1))
    assert not np.array_equal(height, pebbles(x, y, (0.01, 0.03), 0.025, seed=2))


@pytest.mark.slow
def test_the_carving_has_detail_of_a_five_hundredth_of_the_scene():
    """Stems and beads rise by about a centimeter within a centimeter; letters are cut in."""
    x, y = np.meshgrid(np.arange(-WIDTH / 2, WIDTH / 2, 0.002), np.arange(0.0, HIGH, 0.002), indexing="ij")
    height = carving(x, y)

    assert -0.0051 < height.min() < -0.004 and 0.03 < height.max() < 0.045
    shift = round(0.002 * SIZE / 0.002)
    steps = np.abs(height[shift:] - height[:-shift])
    assert 0.1 < np.mean(steps > 0.004) < 0.5


@pytest.mark.slow
def test_a_tree_forks_down_to_twigs():
    lines = tree((0.0, 0.0, 0.0), 2.0, seed=4)

    assert 15 < len(lines) < 400
    radii = np.concatenate([line[:, 3] for line in lines])
    assert radii.max() == pytest.approx(0.045) and 0.003 < radii.min() < 0.006
    starts = {tuple(line[0, :3].round(9)) for line in lines[1:]}
    assert starts <= {tuple(line[-1, :3].round(9)) for line in lines}
    assert all(np.array_equal(a, b) for a, b in zip(lines, tree((0.0, 0.0, 0.0), 2.0, seed=4), strict=True))


@pytest.mark.slow
@pytest.mark.parametrize(("name", "sky"), [("ornament", (0.0, 0.5)), ("railing", (0.05, 0.6)), ("garden", (0.05, 0.6))])
def test_photos_look_at_their_scene_and_see_as_much_sky_as_they_should(name, sky):
    scene, views = build_scene(name), scene_views(name)
    caster = ray_caster(scene.vertices, scene.faces)
    assert scene.name == name and 14 <= len(views.cameras) <= 18
    for photo, pose in views.cam_from_world.items():
        camera = views.cameras[photo]
        coarse = Camera(np.diag([0.05, 0.05, 1.0]) @ camera.K, camera.width // 20, camera.height // 20)
        hits = cast_rays(caster, camera_center(pose), pixel_rays(coarse) @ pose[:, :3])["t_hit"]
        assert sky[0] <= np.mean(~np.isfinite(hits)) <= sky[1]
        assert hits.min() > 1.0, "nobody stands in a tree"


@pytest.mark.slow
def test_thin_things_lie_inside_of_the_surface_and_are_thin():
    scene = build_scene("railing")
    lines = np.concatenate(scene.thin)

    assert 0.003 < lines[:, 3].min() < lines[:, 3].max() < 0.05 < 0.02 * SIZE
    on_surface = ray_caster(scene.vertices, scene.faces).compute_distance(lines[:, :3].astype(np.float32)).numpy()
    assert np.mean(on_surface <= lines[:, 3] + 1e-4) == 1.0
