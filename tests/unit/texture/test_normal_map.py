"""Normal maps of a light plane, baked from fine waves whose normals are known, and read back from a GLB."""

from dataclasses import replace

import numpy as np
import pytest
from painted_box import one_by_one

from benchmarks.surface.lit_model import angles_deg, read_lit
from sfm_app.formats.gltf import write_glb
from sfm_app.frame.scale import move_model
from sfm_app.geometry.poses import Similarity
from sfm_app.meshing.ray_casting import NearestNormals
from sfm_app.runtime.parallel import make_executor, ordered_map
from sfm_app.texture.normal_map import bake_normals
from sfm_app.types import Model, Surface, Texture

HEIGHT, WAVES = 0.008, 25.0
"""Of the fine waves on a square of side 1, whose normals are up to 11 degrees off."""
SIDE = 256
TURN = np.linalg.qr(np.random.default_rng(3).normal(size=(3, 3)))[0]
TURN *= np.linalg.det(TURN)
FLAT = [128, 128, 255]


def wave(x, y):
    return HEIGHT * np.sin(WAVES * x) * np.cos(WAVES * y)


def true_normals(places):
    """Normals of the waves below places of the plane."""
    x, y, _ = (places @ TURN).T
    slopes = [-WAVES * np.cos(WAVES * x) * np.cos(WAVES * y), WAVES * np.sin(WAVES * x) * np.sin(WAVES * y)]
    found = np.stack([HEIGHT * slopes[0], HEIGHT * slopes[1], np.ones_like(x)], axis=1)
    return (found / np.linalg.norm(found, axis=1, keepdims=True)) @ TURN.T


def grid(count):
    """Places (N, 2) in a square of side 1, and the triangles between them, counter-clockwise."""
    x, y = np.meshgrid(np.linspace(0, 1, count + 1), np.linspace(0, 1, count + 1))
    first = (np.arange(count)[:, None] * (count + 1) + np.arange(count)).ravel()
    right, up = first + 1, first + count + 1
    faces = np.concatenate([np.stack([first, right, up], axis=1), np.stack([right, up + 1, up], axis=1)])
    return np.stack([x.ravel(), y.ravel()], axis=1), faces


def fine(count=240, shift=0.0, turned=False):
    flat, faces = grid(count)
    places = np.column_stack([flat, wave(*flat.T) + shift]) @ TURN.T
    return NearestNormals(places.astype(np.float32), (faces[:, ::-1] if turned else faces).astype(np.int32))


def chart(flat, degrees, middle, mirrored):
    """Texture coordinates, 150 texels to a unit, rotated about the middle of the chart."""
    offset = (flat - 0.5 * (flat.min(axis=(0, 1)) + flat.max(axis=(0, 1)))) * [1, 1 if mirrored else -1]  # y goes down
    cosine, sine = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    return offset @ np.array([[cosine, sine], [-sine, cosine]]) * 150 / SIDE + middle


def light(bend=0.0):
    """18 triangles on two pages: three rows in rotated charts, one of them mirrored."""
    flat, faces = grid(3)
    middle_y = flat[faces].mean(axis=1)[:, 1]
    uv, page = np.empty((len(faces), 3, 2)), (middle_y > 2 / 3).astype(np.int32)
    for row, (degrees, at, mirrored) in enumerate(
        ((30, (0.5, 0.27), False), (200, (0.5, 0.75), True), (75, 0.5, False))
    ):
        own = (3 * middle_y).astype(int) == row
        uv[own] = chart(flat[faces[own]], degrees, np.array(at), mirrored)
    places = np.column_stack([flat, bend * (flat[:, 0] - 0.5) ** 2]) @ TURN.T
    surface = Surface(places, faces, np.full(places.shape, 90, np.uint8))
    return Model(surface, Texture(uv.astype(np.float32), page, (np.full((SIDE, SIDE, 3), 90, np.uint8),) * 2))


def baked(model, find):
    return bake_normals(model, find, one_by_one)


def errors_deg(model, *, mapped=True, truth=true_normals):
    """Angles between a viewer's shading normals and the truth, over all parts of the model's GLB."""
    rng, found = np.random.default_rng(0), []
    for part in read_lit(write_glb(model, "m")["m.glb"]):
        face = rng.integers(0, len(part.faces), 3000)
        shares = rng.dirichlet([1, 1, 1], len(face))
        places = (shares[:, :, None] * part.vertices[part.faces[face]]).sum(axis=1)
        found.append(angles_deg(part.shading_normals(face, shares, mapped=mapped), truth(places)))
    return found


@pytest.mark.parametrize("bend", [0.0, 0.02])
def test_a_viewer_shades_a_light_surface_like_the_fine_one(bend):
    model, share = baked(light(bend), fine().find)

    for part in errors_deg(model):
        assert 0.05 < part.mean() < 1.0
        assert np.percentile(part, 99) < 3.0
    assert all(6.0 < part.mean() < 10.0 for part in errors_deg(model, mapped=False))
    assert 0.97 < share < 1.0  # texels of margins lie beside the waves


def test_another_frame_of_the_export_shows_the_same():
    model, _ = baked(light(), fine().find)
    turn = np.linalg.qr(np.random.default_rng(5).normal(size=(3, 3)))[0]
    turn *= np.linalg.det(turn)
    move = Similarity(3.0, turn, np.array([5.0, -2.0, 1.0]))

    found = errors_deg(move_model(model, move), truth=lambda places: true_normals(move.inverse()(places)) @ turn.T)

    assert all(0.05 < part.mean() < 1.0 for part in found)


@pytest.mark.parametrize(
    ("find", "least", "most"),
    [
        (fine(shift=0.004).find, 0.9, 1.0),  # an edge of the fine surface away
        (fine(shift=0.05).find, 0.0, 0.0),  # twelve edges
        (fine(turned=True).find, 0.0, 0.0),
        (NearestNormals(np.empty((0, 3), np.float32), np.empty((0, 3), np.int32)).find, 0.0, 0.0),
    ],
    ids=["near", "far", "opposite", "nothing"],
)
def test_a_distant_or_reversed_fine_surface_has_no_effect(find, least, most):
    model, share = baked(light(), find)

    assert least <= share <= most
    flat = [(one == FLAT).all() for one in model.texture.normal_maps]
    assert flat == [most == 0.0] * 2


def test_triangles_without_a_photo_stay_flat():
    model = light()
    uv = model.texture.uv.copy()
    unseen = np.flatnonzero(model.texture.page == 1)
    corners = np.array([[10.5, 20.5], [11.5, 20.5], [10.5, 21.5]])
    uv[unseen] = (corners / SIDE).astype(np.float32)

    model, _ = baked(replace(model, texture=replace(model.texture, uv=uv)), fine().find)

    first, second = model.texture.normal_maps
    assert (first != FLAT).any()
    assert (second == FLAT).all()


def test_any_number_of_workers_gives_the_same_bytes():
    whole, _ = baked(light(), fine().find)
    for workers in (1, 2):
        with make_executor(workers) as executor:
            model, _ = bake_normals(
                light(), fine().find, lambda work, parts, _: list(ordered_map(executor, work, parts, 4)), band=20 * SIDE
            )
        np.testing.assert_array_equal(model.texture.normal_maps, whole.texture.normal_maps)


def test_maps_have_half_the_side_of_odd_pages_and_a_model_without_a_texture_stays():
    model = light()
    pages = (np.zeros((201, 131, 3), np.uint8),) * 2

    found, _ = baked(replace(model, texture=replace(model.texture, pages=pages)), fine().find)

    assert [one.shape for one in found.texture.normal_maps] == [(101, 66, 3)] * 2
    bare = Model(model.surface)
    assert baked(bare, fine().find) == (bare, 0.0)
