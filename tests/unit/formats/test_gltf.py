"""GLB files, plain and compressed, taken apart by the rules of glTF 2.0 and read back by other programs."""

import io
import json
import struct
from dataclasses import replace

import numpy as np
import pytest
import trimesh
from PIL import Image

from sfm_app.formats.draco import DRACO, write_draco
from sfm_app.formats.exporters import jpeg, split_corners
from sfm_app.formats.gltf import linear_colors, write_glb
from sfm_app.types import Model, Surface

COMPONENTS = {5123: np.uint16, 5125: np.uint32, 5126: np.float32}
WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}


def glb_of(model):
    (data,) = write_glb(model, "model").values()
    return data


def taken_apart(data):
    """Tree and buffer of a GLB, whose container is checked on the way."""
    magic, version, length = struct.unpack_from("<4sII", data)
    assert (magic, version, length) == (b"glTF", 2, len(data))
    size, kind = struct.unpack_from("<I4s", data, 12)
    assert (size % 4, kind) == (0, b"JSON")
    tree, rest = json.loads(data[20 : 20 + size]), data[20 + size :]
    length, kind = struct.unpack_from("<I4s", rest)
    assert (length % 4, kind, length) == (0, b"BIN\0", len(rest) - 8)
    assert tree["buffers"] == [{"byteLength": length}]
    return tree, rest[8:]


def array(tree, buffer, number):
    entry = tree["accessors"][number]
    view = tree["bufferViews"][entry["bufferView"]]
    kind, width = np.dtype(COMPONENTS[entry["componentType"]]), WIDTHS[entry["type"]]
    assert view["byteOffset"] % 4 == 0
    assert view["byteLength"] == entry["count"] * width * kind.itemsize
    values = np.frombuffer(buffer, kind, entry["count"] * width, view["byteOffset"])
    return values.reshape(-1, width) if width > 1 else values


@pytest.fixture(params=["ball", "textured_ball", "lit_ball", "cloud"])
def model(request):
    return request.getfixturevalue(request.param)


def test_views_follow_each_other_and_every_accessor_is_used_once(model):
    tree, buffer = taken_apart(glb_of(model))
    primitives = [primitive for mesh in tree["meshes"] for primitive in mesh["primitives"]]
    used = [number for p in primitives for number in p["attributes"].values()]
    used += [p["indices"] for p in primitives if "indices" in p]
    assert sorted(used) == list(range(len(tree["accessors"])))
    end = 0
    for view in tree["bufferViews"]:
        assert 0 <= view["byteOffset"] - end < 4
        end = view["byteOffset"] + view["byteLength"]
    assert 0 <= len(buffer) - end < 4


def test_numbers_are_what_the_tree_says_of_them(model):
    tree, buffer = taken_apart(glb_of(model))
    for primitive in (p for mesh in tree["meshes"] for p in mesh["primitives"]):
        entry = tree["accessors"][primitive["attributes"]["POSITION"]]
        places = array(tree, buffer, primitive["attributes"]["POSITION"])
        assert (entry["min"], entry["max"]) == (places.min(axis=0).tolist(), places.max(axis=0).tolist())
        if "NORMAL" in primitive["attributes"]:
            normals = array(tree, buffer, primitive["attributes"]["NORMAL"])
            np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1, atol=1e-6)
            assert np.sum(normals * places, axis=1).min() > 0.98  # outward: it is a ball
        if "indices" in primitive:
            indices = array(tree, buffer, primitive["indices"])
            assert set(indices) == set(range(len(places)))
            assert tree["bufferViews"][tree["accessors"][primitive["indices"]]["bufferView"]]["target"] == 34963


@pytest.mark.parametrize("name", ["ball", "textured_ball", "cloud"])
def test_every_material_shows_colors_as_they_are_from_both_sides(name, request):
    tree, _ = taken_apart(glb_of(request.getfixturevalue(name)))
    assert tree["asset"] == {"version": "2.0", "generator": "sfm_app"}
    assert tree["extensionsUsed"] == ["KHR_materials_unlit"]
    assert "extensionsRequired" not in tree
    for material in tree["materials"]:
        assert material["doubleSided"] is True
        assert material["extensions"] == {"KHR_materials_unlit": {}}
        assert material["pbrMetallicRoughness"]["metallicFactor"] == 0.0


def test_each_page_is_a_jpeg_and_a_primitive_of_its_own(textured_ball):
    tree, buffer = taken_apart(glb_of(textured_ball))
    primitives = tree["meshes"][0]["primitives"]
    assert len(primitives) == len(tree["images"]) == 2
    for primitive, page in zip(primitives, textured_ball.texture.pages, strict=True):
        base = tree["materials"][primitive["material"]]["pbrMetallicRoughness"]["baseColorTexture"]
        image = tree["images"][tree["textures"][base["index"]]["source"]]
        view = tree["bufferViews"][image["bufferView"]]
        data = buffer[view["byteOffset"] : view["byteOffset"] + view["byteLength"]]
        picture = Image.open(io.BytesIO(data))
        assert (image["mimeType"], picture.format, data[:3]) == ("image/jpeg", "JPEG", b"\xff\xd8\xff")
        assert set(view) == {"buffer", "byteOffset", "byteLength"}
        np.testing.assert_allclose(np.asarray(picture), page, atol=4)
        assert set(primitive["attributes"]) == {"POSITION", "NORMAL", "TEXCOORD_0"}


def test_a_normal_map_makes_a_material_lit_and_comes_with_its_frames(lit_ball):
    surface, texture = lit_ball.surface, lit_ball.texture
    tree, buffer = taken_apart(glb_of(lit_ball))

    assert not {"extensionsUsed", "extensionsRequired"} & set(tree)
    for primitive, relief in zip(tree["meshes"][0]["primitives"], texture.normal_maps, strict=True):
        material = tree["materials"][primitive["material"]]
        rough = material["pbrMetallicRoughness"]
        assert (rough["metallicFactor"], rough["roughnessFactor"], material["doubleSided"]) == (0.0, 1.0, True)
        assert "extensions" not in material
        image = tree["images"][tree["textures"][material["normalTexture"]["index"]]["source"]]
        view = tree["bufferViews"][image["bufferView"]]
        picture = Image.open(io.BytesIO(buffer[view["byteOffset"] : view["byteOffset"] + view["byteLength"]]))
        assert image["mimeType"] == f"image/{picture.format.lower()}"
        np.testing.assert_allclose(np.asarray(picture), relief, atol=4)
        normals, tangents = (array(tree, buffer, primitive["attributes"][name]) for name in ("NORMAL", "TANGENT"))
        np.testing.assert_allclose(np.linalg.norm(tangents[:, :3], axis=1), 1, atol=1e-6)
        np.testing.assert_allclose(np.sum(tangents[:, :3] * normals, axis=1), 0, atol=1e-6)
        assert set(tangents[:, 3]) <= {-1.0, 1.0}
    corners = sum(len(array(tree, buffer, one["indices"])) for one in tree["meshes"][0]["primitives"])
    assert corners == surface.faces.size


def test_cameras_beside_a_lit_model_stay_unlit(lit_ball, cloud):
    tree, _ = taken_apart(glb_of(replace(lit_ball, cameras=cloud.cameras)))
    assert tree["extensionsUsed"] == ["KHR_materials_unlit"]
    assert ["extensions" in one for one in tree["materials"]] == [False, False, True]


def test_corners_keep_their_place_in_the_texture(textured_ball):
    surface, texture = textured_ball.surface, textured_ball.texture
    tree, buffer = taken_apart(glb_of(textured_ball))
    for page, primitive in enumerate(tree["meshes"][0]["primitives"]):
        here = texture.page == page
        corners = array(tree, buffer, primitive["indices"]).reshape(-1, 3)
        places, uv = (array(tree, buffer, primitive["attributes"][key])[corners] for key in ("POSITION", "TEXCOORD_0"))
        np.testing.assert_allclose(places, surface.vertices[surface.faces[here]], atol=1e-6)
        np.testing.assert_array_equal(uv, texture.uv[here])


def test_a_page_that_nothing_lies_on_is_left_out(textured_ball):
    texture = textured_ball.texture
    spare = replace(texture, page=texture.page * 2, pages=(texture.pages[0], texture.pages[0], texture.pages[1]))
    tree, _ = taken_apart(glb_of(replace(textured_ball, texture=spare)))
    assert [image["name"] for image in tree["images"]] == ["page 0", "page 2"]


def test_only_corners_on_borders_of_charts_are_split():
    faces = np.array([[0, 1, 2], [2, 1, 3], [3, 1, 4]])
    places = np.random.default_rng(0).random((6, 2)).astype(np.float32)
    uv = places[np.array([[0, 1, 2], [2, 1, 3], [3, 5, 4]])]  # vertex 1 has two places
    old, place, new = split_corners(faces, uv)
    assert old.tolist() in ([0, 1, 1, 2, 3, 4],)
    np.testing.assert_array_equal(old[new], faces)
    np.testing.assert_array_equal(place[new], uv)


@pytest.mark.parametrize(("vertices", "kind"), [(65535, 5123), (65536, 5125)])
def test_indices_are_as_small_as_fits(vertices, kind):
    rng = np.random.default_rng(0)
    faces = np.arange(vertices + (-vertices) % 3).reshape(-1, 3) % vertices
    surface = Surface(rng.random((vertices, 3)), faces, np.zeros((vertices, 3), np.uint8))
    tree, buffer = taken_apart(glb_of(Model(surface)))
    number = tree["meshes"][0]["primitives"][0]["indices"]
    assert tree["accessors"][number]["componentType"] == kind
    assert array(tree, buffer, number).max() == vertices - 1


def test_linear_colors_come_back_as_the_srgb_they_were():
    every = np.arange(256, dtype=np.uint8)
    light = linear_colors(np.column_stack([every, every, every]))
    np.testing.assert_allclose(light[[0, 10, 128, 188, 255], 0], [0, 0.003035, 0.215861, 0.502886, 1], atol=1e-6)
    back = np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)
    np.testing.assert_array_equal(np.round(255 * back[:, 1]), every)


def test_a_triangle_without_area_still_has_a_unit_normal():
    vertices = np.array([[0.0, 0, 0], [1, 0, 0], [0, 0, -1], [5, 5, 5]])
    surface = Surface(vertices, np.array([[0, 1, 2], [3, 3, 3]]), np.full((4, 3), 128, np.uint8))
    tree, buffer = taken_apart(glb_of(Model(surface)))
    normals = array(tree, buffer, tree["meshes"][0]["primitives"][0]["attributes"]["NORMAL"])
    np.testing.assert_allclose(normals, np.tile([0.0, 1, 0], (4, 1)), atol=1e-6)


def test_points_and_cameras(cloud):
    tree, buffer = taken_apart(glb_of(cloud))
    points, frusta = (mesh["primitives"][0] for mesh in tree["meshes"])
    assert (points["mode"], "indices" in points, frusta["mode"]) == (0, False, 1)
    np.testing.assert_allclose(array(tree, buffer, points["attributes"]["POSITION"]), cloud.surface.vertices, atol=1e-6)
    assert len(array(tree, buffer, frusta["indices"])) == 2 * 8 * len(cloud.cameras)
    assert len(array(tree, buffer, frusta["attributes"]["POSITION"])) == 5 * len(cloud.cameras)


def test_cameras_of_gltf_stand_where_the_photos_were_taken(cloud):
    tree, _ = taken_apart(glb_of(cloud))
    nodes = [node for node in tree["nodes"] if "camera" in node]
    assert [node["name"] for node in nodes] == [camera.name for camera in cloud.cameras]
    for node, camera in zip(nodes, cloud.cameras, strict=True):
        world_from_gltf = np.array(node["matrix"]).reshape(4, 4).T
        ahead, up = -world_from_gltf[:3, 2], world_from_gltf[:3, 1]
        R, t = camera.cam_from_world[:, :3], camera.cam_from_world[:, 3]
        np.testing.assert_allclose(R @ world_from_gltf[:3, 3] + t, 0, atol=1e-9)
        np.testing.assert_allclose(R @ ahead, [0, 0, 1], atol=1e-9)
        np.testing.assert_allclose(R @ up, [0, -1, 0], atol=1e-9)
        lens = tree["cameras"][node["camera"]]["perspective"]
        assert np.tan(lens["yfov"] / 2) == pytest.approx(240 / 820)
        assert np.tan(lens["yfov"] / 2) * lens["aspectRatio"] == pytest.approx(320 / 800)


def test_trimesh_takes_vertex_colors_where_it_skips_materials(ball):
    mesh = trimesh.load(io.BytesIO(glb_of(ball)), file_type="glb", force="mesh", process=False, skip_materials=True)
    expected = linear_colors(ball.surface.colors) * 255
    np.testing.assert_allclose(mesh.visual.vertex_colors[:, :3], expected, atol=1)


def test_colors_of_neighboring_charts_stay_apart():
    page = np.zeros((64, 64, 3), np.uint8)
    page[:, ::2], page[:, 1::2] = (220, 30, 30), (30, 30, 220)
    back = np.asarray(Image.open(io.BytesIO(jpeg(page)))).astype(float)
    assert 0 < np.abs(back - page).mean() < 6


def test_a_page_of_noise_is_written_too():
    page = np.random.default_rng(0).integers(0, 255, (200, 300, 3), np.uint8)
    data = jpeg(page)
    assert len(data) > page.shape[0] * page.shape[1]  # more than Pillow expects
    assert np.abs(np.asarray(Image.open(io.BytesIO(data))).astype(int) - page).mean() < 10


def read(data, folder):
    (folder / "model.glb").write_bytes(data)
    return list(trimesh.load_scene(folder / "model.glb", process=False).geometry.values())


def corners(parts, values):
    """Rows of values at all corners of triangles, behind the places of the corners, sorted."""
    rows = [
        np.hstack([part.vertices, values(part)])[part.faces].reshape(-1, 3 + values(part).shape[1]) for part in parts
    ]
    found = np.concatenate(rows)
    return found[np.lexsort(np.round(found[:, ::-1], 4).T)]


def test_the_textured_model_is_the_same_as_without_compression(textured_ball, tmp_path):
    data = write_draco(textured_ball, "model")["model.glb"]
    small, plain = read(data, tmp_path), read(write_glb(textured_ball, "model")["model.glb"], tmp_path)
    places = [corners(parts, lambda part: np.asarray(part.visual.uv)) for parts in (small, plain)]
    np.testing.assert_allclose(places[0][:, :3], places[1][:, :3], atol=1e-6)  # 2 units in 20 bits
    np.testing.assert_allclose(places[0][:, 3:], places[1][:, 3:], atol=2e-5)
    for one, other in zip(small, plain, strict=True):
        pages = [np.asarray(part.visual.material.baseColorTexture) for part in (one, other)]
        np.testing.assert_array_equal(*pages)
    assert len(data) < 0.7 * len(write_glb(textured_ball, "model")["model.glb"])


def test_what_the_file_says_of_its_attributes_is_what_draco_decodes_to(textured_ball):
    found, _ = taken_apart(write_draco(textured_ball, "model")["model.glb"])
    assert DRACO in found["extensionsRequired"] and DRACO in found["extensionsUsed"]
    for primitive in found["meshes"][0]["primitives"]:
        assert set(primitive["extensions"][DRACO]["attributes"]) == set(primitive["attributes"])
        accessors = [found["accessors"][number] for number in primitive["attributes"].values()]
        assert len({entry["count"] for entry in accessors}) == 1
        assert all("bufferView" not in entry for entry in accessors)
        low, high = (found["accessors"][primitive["attributes"]["POSITION"]][key] for key in ("min", "max"))
        assert np.all(np.array(low) >= -1.00001) and np.all(np.array(high) <= 1.00001)


def test_colors_of_vertices_keep_sixteen_bits(ball, tmp_path):
    import DracoPy

    found, buffer = taken_apart(write_draco(ball, "model")["model.glb"])
    (primitive,) = found["meshes"][0]["primitives"]
    view = found["bufferViews"][primitive["extensions"][DRACO]["bufferView"]]
    decoded = DracoPy.decode(buffer[view["byteOffset"] : view["byteOffset"] + view["byteLength"]])

    number = primitive["extensions"][DRACO]["attributes"]["COLOR_0"]
    color = next(attribute for attribute in decoded.attributes if attribute["unique_id"] == number)
    accessor = found["accessors"][primitive["attributes"]["COLOR_0"]]
    assert accessor["normalized"] is True and accessor["componentType"] == 5123
    at = np.linalg.norm(ball.surface.vertices[:, None] - np.asarray(decoded.points)[None], axis=2).argmin(axis=1)
    np.testing.assert_allclose(np.asarray(color["data"])[at] / 65535, linear_colors(ball.surface.colors), atol=1e-5)


def test_points_are_those_of_a_plain_file(cloud):
    assert write_draco(cloud, "points") == write_glb(cloud, "points")
