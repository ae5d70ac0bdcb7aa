import math

import numpy as np
import pytest

from benchmarks.synthetic.scenes import SCENES, build_scene
from sfm_app.errors import ConfigError
from sfm_app.synthetic.shapes import arch, ball, box, ground, revolve, torus

VASE = np.array([[0.0, 0.0], [0.3, 0.0], [0.2, 0.5], [0.4, 1.0], [0.0, 1.0]])


def signed_volume(shape):
    a, b, c = (shape.vertices[shape.faces[:, k]] for k in range(3))
    return float(np.sum(a * np.cross(b, c)) / 6)


def cone(bottom, top, height):
    return math.pi * height / 3 * (bottom**2 + bottom * top + top**2)


@pytest.mark.parametrize(
    ("shape", "volume"),
    [
        (box(1.0, 2.0, 3.0), 6.0),
        (box(1.0, 2.0, 3.0).move((5.0, -1.0, 2.0), turn_deg=20.0, tilt_deg=50.0), 6.0),
        (ball(0.5), math.pi / 6),
        (torus(1.0, 0.2), 2 * math.pi**2 * 0.04),
        (revolve(VASE, segments=200), cone(0.3, 0.2, 0.5) + cone(0.2, 0.4, 0.5)),
        (revolve(VASE, segments=200, sharp=True), cone(0.3, 0.2, 0.5) + cone(0.2, 0.4, 0.5)),
        (arch(1.0, 0.5, 0.4), math.pi / 2 * (1.5**2 - 1.0**2) * 0.4),  # its open feet lie in y = 0
    ],
    ids=["box", "moved box", "ball", "torus", "vase", "sharp vase", "arch"],
)
def test_triangles_enclose_the_right_volume_from_outside(shape, volume):
    assert signed_volume(shape) == pytest.approx(volume, rel=0.02)


@pytest.mark.parametrize("shape", [box(1.0, 1.0, 1.0), ball(1.0), torus(1.0, 0.2), revolve(VASE, sharp=True)])
def test_normals_are_unit_and_point_as_the_triangles(shape):
    a, b, c = (shape.vertices[shape.faces[:, k]] for k in range(3))
    cross = np.cross(b - a, c - a)
    face_normals = cross / np.linalg.norm(cross, axis=1, keepdims=True)

    assert np.allclose(np.linalg.norm(shape.normals, axis=1), 1.0)
    assert np.einsum("nc,nkc->nk", face_normals, shape.normals[shape.faces]).min() > 0.5


def test_moving_turns_normals_and_keeps_texture_places():
    still = ball(1.0, segments=32)
    moved = still.move((1.0, 2.0, 3.0), turn_deg=90.0)

    assert np.array_equal(moved.texture, still.texture)
    assert np.allclose(moved.vertices.mean(axis=0) - still.vertices.mean(axis=0), [1.0, 2.0, 3.0])
    assert np.allclose(moved.normals[:, 2], -still.normals[:, 0]), "turning takes +x to -z"


def test_flutes_cut_into_a_column():
    column = revolve(np.array([[1.0, 0.0], [1.0, 2.0]]), segments=200, flutes=(20, 0.1))
    radius = np.hypot(column.vertices[:, 0], column.vertices[:, 2])
    assert radius.max() == pytest.approx(1.0, abs=1e-6) and radius.min() == pytest.approx(0.9, abs=1e-3)


def test_bumps_make_a_ball_uneven():
    radius = np.linalg.norm(ball(2.0, bumps=0.1, seed=1).vertices, axis=1)
    assert 0.1 < radius.std() / 2.0 / 0.1 < 3.0
    assert not np.array_equal(ball(2.0, bumps=0.1, seed=1).vertices, ball(2.0, bumps=0.1, seed=2).vertices)


def test_ground_faces_up_and_is_uneven():
    floor = ground((-1.0, 1.0), (-2.0, 2.0), unevenness=0.05)
    assert floor.normals[:, 1].min() > 0.8
    assert 0.02 < np.ptp(floor.vertices[:, 1]) < 0.2
    assert np.allclose(np.ptp(floor.vertices[:, [0, 2]], axis=0), [2.0, 4.0])


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
