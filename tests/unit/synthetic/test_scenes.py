import numpy as np
import pytest

from benchmarks.synthetic.scenes import PLASTER, WALKS, build_scene, corner, scene_views
from benchmarks.synthetic.walks import WallWalkOptions, wall_walk
from sfm_app.errors import ConfigError
from sfm_app.synthetic.cameras import camera_center, make_camera, pixel_rays
from sfm_app.synthetic.render import GAMMA, cast_rays, prepare, ray_caster, render_scene
from sfm_app.synthetic.scenes import bust_field
from sfm_app.synthetic.shapes import assemble, ball, box, carve, waves

pytestmark = pytest.mark.slow


def signed_volume(shape):
    a, b, c = (shape.vertices[shape.faces[:, k]] for k in range(3))
    return float(np.sum(a * np.cross(b, c)) / 6)


def egg(points):
    """Positive in an ellipsoid with the half axes 0.5, 1, 0.25 around (0.1, 0, 0), which holds the axis."""
    return 1.0 - (((points - [0.1, 0.0, 0.0]) / [0.5, 1.0, 0.25]) ** 2).sum(axis=1)


def test_a_carved_body_is_what_its_field_says():
    shape = carve(egg, (-1.1, 1.1), reach=0.8)
    assert signed_volume(shape) == pytest.approx(4 / 3 * np.pi * 0.5 * 0.25, rel=0.02)
    sides = shape.vertices[np.hypot(shape.vertices[:, 0], shape.vertices[:, 2]) > 0]
    assert np.abs(egg(sides)).max() < 0.02, "every vertex lies on it"
    assert shape.vertices[:, 0].max() == pytest.approx(0.6, abs=0.005)
    assert shape.vertices[:, 0].min() == pytest.approx(-0.4, abs=0.005)


def test_a_carved_body_is_closed():
    shape = carve(egg, (-1.1, 1.1), reach=0.8, rows=40, segments=24)
    _, whole = np.unique(np.round(shape.vertices, 9), axis=0, return_inverse=True)
    faces = whole.ravel()[shape.faces]
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    edges = edges[edges[:, 0] != edges[:, 1]]
    assert {tuple(edge) for edge in edges} == {tuple(edge[::-1]) for edge in edges}


def test_an_assembled_body_has_one_texture_that_runs_on():
    parts = [box(1.0, 1.0, 1.0).move((x, 0.0, 0.0), turn_deg=90.0) for x in (0.0, 2.0)]
    both = assemble(parts)
    assert np.array_equal(both.texture, both.vertices) and len(both.vertices) == 2 * len(parts[0].vertices)
    assert signed_volume(both) == pytest.approx(2.0)
    assert np.array_equal(both.normals[: len(parts[0].normals)], parts[0].normals)


def test_waves_have_unit_variance_and_a_seed():
    points = np.random.default_rng(0).uniform(-20, 20, (20_000, 3))
    assert waves(points, 1).std() == pytest.approx(1.0, abs=0.05) and abs(waves(points, 1).mean()) < 0.05
    assert abs(np.corrcoef(waves(points, 1), waves(points, 2))[0, 1]) < 0.05
    near = waves(points + 1e-5, 1)
    assert 0 < np.abs(near - waves(points, 1)).max() < 1e-2


def test_the_bust_has_a_face_at_the_front_only():
    """The nose stands out towards +z by some centimeters; hair and cloth are rough, the face is smooth."""

    def depth(x, y, side):
        z = np.linspace(0.6, 0.0, 1201)
        inside = bust_field(np.column_stack([np.full_like(z, x), np.full_like(z, y), side * z])) > 0
        return z[inside.argmax()]

    nose, cheek = depth(0.0, 0.83, 1.0), np.mean([depth(x, 0.83, 1.0) for x in (-0.06, 0.06)])
    assert 0.02 < nose - cheek < 0.12
    assert bust_field(np.array([[0.0, 0.3, 0.0], [0.0, 0.9, 0.0], [0.0, 0.6, 0.0]])).min() > 0
    assert bust_field(np.array([[0.7, 0.3, 0.0], [0.0, 1.3, 0.0], [0.3, 0.9, 0.0]])).max() < 0


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


def test_the_statue_is_seen_all_round_and_the_facade_from_the_street():
    eyes = np.array([camera_center(pose) for pose in scene_views("statue").cam_from_world.values()])
    around = np.sort(np.degrees(np.arctan2(eyes[:, 0], eyes[:, 2])))
    assert max(np.diff(around).max(), 360 - np.ptp(around)) < 25
    along = np.array([camera_center(pose) for pose in scene_views("facade").cam_from_world.values()])
    assert np.ptp(along[:, 0]) > 7 and along[:, 2].min() > 5 and np.all(np.diff(along[:, 0]) > 0)


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


def test_a_walk_past_a_wall_turns_its_head():
    views = wall_walk(make_camera(120, 80), WallWalkOptions(photos=8, length=6.0), seed=1)
    poses = np.array(list(views.cam_from_world.values()))
    eyes = np.array([camera_center(pose) for pose in poses])
    assert np.allclose(np.diff(eyes[:, 0]), 6.0 / 7) and np.all((eyes[:, 2] > 5) & (eyes[:, 2] < 7))
    ways = poses[:, 2, :3]
    angles = np.degrees(np.arccos(np.clip(ways @ ways.T, -1, 1)))
    assert np.all(ways[:, 2] < -0.7) and 10 < angles.max() < 80, "parallel axes would leave the focal undetermined"
    other = wall_walk(make_camera(120, 80), WallWalkOptions(photos=8, length=6.0), seed=2)
    assert not np.allclose(poses, np.array(list(other.cam_from_world.values())))
    with pytest.raises(ConfigError, match="photos, length or roll_deg"):
        WallWalkOptions(photos=1)


def test_walks_are_of_known_scenes():
    assert set(WALKS) == {"courtyard", "statue", "facade", "corner", "town", "ornament", "railing", "garden"}
    with pytest.raises(ConfigError, match="poster") as caught:
        scene_views("poster")
    assert "statue" in caught.value.hint


def test_a_body_of_several_balls_is_as_large_as_they_are():
    both = assemble([ball(0.5), ball(0.5).move((3.0, 0.0, 0.0))])
    assert signed_volume(both) == pytest.approx(np.pi / 3, rel=0.02)
