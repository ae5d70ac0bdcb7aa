"""Mesh files, read back."""

import io
import json
import struct

import numpy as np
import pytest
import trimesh

from sfm_app.errors import ReconstructionError
from sfm_app.formats import EXPORTERS
from sfm_app.formats.mesh_files import srgb_to_linear


@pytest.fixture
def ball() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    mesh = trimesh.creation.icosphere(subdivisions=2)
    vertices = np.array(mesh.vertices, np.float64)
    return vertices, np.array(mesh.faces, np.int64), np.clip(128 + 120 * vertices, 0, 255).astype(np.uint8)


def gltf_tree(data: bytes) -> dict:
    length = struct.unpack("<I", data[12:16])[0]
    return json.loads(data[20 : 20 + length])


@pytest.mark.parametrize("name", EXPORTERS)
def test_shape_and_normals_survive(name, ball):
    vertices, faces, colors = ball

    mesh = trimesh.load(
        io.BytesIO(EXPORTERS[name][0](vertices, faces, colors)), file_type=name, force="mesh", process=False
    )

    np.testing.assert_allclose(mesh.vertices, vertices, atol=1e-6)
    np.testing.assert_array_equal(mesh.faces, faces)
    assert np.min(np.sum(mesh.vertex_normals * vertices, axis=1)) > 0.99


def test_ply_keeps_the_colours_of_the_photos(ball):
    mesh = trimesh.load(io.BytesIO(EXPORTERS["ply"][0](*ball)), file_type="ply", process=False)

    np.testing.assert_array_equal(mesh.visual.vertex_colors[:, :3], ball[2])


def test_glb_has_linear_colours_that_come_back_as_srgb(ball):
    data = EXPORTERS["glb"][0](*ball)

    scene = trimesh.load(io.BytesIO(data), file_type="glb", process=False)
    light = next(iter(scene.geometry.values())).visual.vertex_attributes["color"]

    np.testing.assert_allclose(light, srgb_to_linear(ball[2]), atol=1e-7)
    back = np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)
    np.testing.assert_array_equal(np.round(255 * back).astype(np.uint8), ball[2])


def test_glb_colours_are_vertex_colours_for_programs_that_skip_materials(ball):
    data = EXPORTERS["glb"][0](*ball)

    mesh = trimesh.load(io.BytesIO(data), file_type="glb", force="mesh", process=False, skip_materials=True)

    expected = np.round(255 * srgb_to_linear(ball[2]))
    np.testing.assert_allclose(mesh.visual.vertex_colors[:, :3].astype(float), expected, atol=1)


def test_glb_material_is_rough_and_two_sided(ball):
    tree = gltf_tree(EXPORTERS["glb"][0](*ball))

    primitive = tree["meshes"][0]["primitives"][0]
    material = tree["materials"][primitive["material"]]
    assert set(primitive["attributes"]) == {"POSITION", "NORMAL", "COLOR_0"}
    assert material["doubleSided"] is True
    assert material["pbrMetallicRoughness"] == {"metallicFactor": 0.0, "roughnessFactor": 1.0}


@pytest.mark.parametrize("name", EXPORTERS)
def test_same_mesh_same_bytes(name, ball):
    write = EXPORTERS[name][0]
    assert write(*ball) == write(*(part.copy() for part in ball))


@pytest.mark.parametrize("name", EXPORTERS)
def test_an_empty_mesh_is_refused(name, ball):
    with pytest.raises(ReconstructionError, match="no triangles"):
        EXPORTERS[name][0](ball[0], np.empty((0, 3), np.int64), ball[2])


def test_srgb_curve_is_the_standard_one():
    light = srgb_to_linear(np.arange(256, dtype=np.uint8))

    assert light[0] == 0
    assert light[255] == 1
    assert np.all(np.diff(light) > 0)
    np.testing.assert_allclose(light[[10, 128, 188]], [0.003035, 0.215861, 0.502886], atol=1e-6)


def test_a_triangle_without_area_still_has_unit_normals():
    vertices = np.array([[0.0, 0, 0], [1, 0, 0], [0, 0, -1], [5, 5, 5]])
    faces = np.array([[0, 1, 2], [3, 3, 3]])

    data = EXPORTERS["ply"][0](vertices, faces, np.full((4, 3), 128, np.uint8))
    raw = trimesh.load(io.BytesIO(data), file_type="ply", process=False).metadata["_ply_raw"]["vertex"]["data"]

    np.testing.assert_allclose(raw["nx"] ** 2 + raw["ny"] ** 2 + raw["nz"] ** 2, 1, atol=1e-6)
    np.testing.assert_allclose(raw["ny"], 1, atol=1e-6)
