"""GLB compressed by Draco, as trimesh reads it with DracoPy."""

import json
import struct

import numpy as np
import trimesh

from sfm_app.formats.draco import DRACO, write_draco
from sfm_app.formats.gltf import linear_colors, write_glb


def tree(data):
    (length,) = struct.unpack_from("<I", data, 12)
    return json.loads(data[20 : 20 + length])


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
    found = tree(write_draco(textured_ball, "model")["model.glb"])
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

    data = write_draco(ball, "model")["model.glb"]
    found = tree(data)
    (primitive,) = found["meshes"][0]["primitives"]
    view = found["bufferViews"][primitive["extensions"][DRACO]["bufferView"]]
    start = 20 + struct.unpack_from("<I", data, 12)[0] + 8 + view["byteOffset"]
    decoded = DracoPy.decode(data[start : start + view["byteLength"]])

    color = next(
        a for a in decoded.attributes if a["unique_id"] == primitive["extensions"][DRACO]["attributes"]["COLOR_0"]
    )
    accessor = found["accessors"][primitive["attributes"]["COLOR_0"]]
    assert accessor["normalized"] is True and accessor["componentType"] == 5123
    at = np.linalg.norm(ball.surface.vertices[:, None] - np.asarray(decoded.points)[None], axis=2).argmin(axis=1)
    np.testing.assert_allclose(np.asarray(color["data"])[at] / 65535, linear_colors(ball.surface.colors), atol=1e-5)


def test_points_are_those_of_a_plain_file(cloud):
    assert write_draco(cloud, "points") == write_glb(cloud, "points")
