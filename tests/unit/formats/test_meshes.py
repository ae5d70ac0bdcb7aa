"""PLY, OBJ and STL files, read back by other programs, and cameras drawn into them."""

import io

import numpy as np
import pytest
import trimesh
from PIL import Image

from sfm_app.formats.frusta import CAMERA_COLOR, DOTS, camera_dots, camera_lines, frustum_corners, frustum_depth
from sfm_app.formats.meshes import DIGITS, write_obj, write_ply, write_stl
from sfm_app.meshing.ray_casting import load_open3d
from sfm_app.types import Model, Surface


def rows(model):
    (data,) = write_ply(model, "model").values()
    return trimesh.load(io.BytesIO(data), file_type="ply", process=False).metadata["_ply_raw"]


def test_a_surface_has_places_normals_and_the_colors_of_the_photos(ball):
    vertex = rows(ball)["vertex"]["data"]
    places, normals, colors = (
        np.stack([vertex[key] for key in keys], axis=1)
        for keys in (("x", "y", "z"), ("nx", "ny", "nz"), ("red", "green", "blue"))
    )
    np.testing.assert_allclose(places, ball.surface.vertices, atol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1, atol=1e-6)
    assert np.sum(normals * places, axis=1).min() > 0.98
    np.testing.assert_array_equal(colors, ball.surface.colors)
    assert set(rows(ball)) == {"vertex", "face"}


def test_the_texture_leaves_the_bytes_alone(ball, textured_ball):
    assert write_ply(ball, "model") == write_ply(textured_ball, "model")


def test_cameras_are_dotted_lines_behind_the_points(cloud):
    vertex = rows(cloud)["vertex"]["data"]
    count = len(cloud.surface.vertices)
    painted = np.stack([vertex[key] for key in ("red", "green", "blue")], axis=1) == CAMERA_COLOR
    assert len(vertex) == count + 8 * DOTS * len(cloud.cameras)
    assert painted.all(axis=1)[count:].all()
    assert set(rows(cloud)) == {"vertex"}


def lines(files, start):
    text = next(iter(files.values())).decode()
    return [line.split()[1:] for line in text.splitlines() if line.split()[0] == start]


def test_every_corner_has_its_vertex_its_place_in_the_texture_and_its_normal(textured_ball):
    surface, texture = textured_ball.surface, textured_ball.texture
    files = write_obj(textured_ball, "model")
    v, vt, vn = (np.array(lines(files, key), float) for key in ("v", "vt", "vn"))
    corners = np.array([[corner.split("/") for corner in face] for face in lines(files, "f")], int) - 1
    order = np.concatenate([np.flatnonzero(texture.page == page) for page in (0, 1)])
    np.testing.assert_allclose(v[corners[:, :, 0]], surface.vertices[surface.faces[order]], atol=1e-6)
    np.testing.assert_allclose(vt[corners[:, :, 1]] * [1, -1] + [0, 1], texture.uv[order], atol=1e-6)
    np.testing.assert_allclose(np.sum(v[corners[:, :, 0]] * vn[corners[:, :, 2]], axis=2), 1, atol=0.02)
    assert len(np.unique(vt, axis=0)) == len(vt)


def test_the_materials_name_the_pages_beside_them(textured_ball):
    files = write_obj(textured_ball, "my model")
    assert list(files) == ["my model.obj", "my_model.mtl", "my_model_0.jpg", "my_model_1.jpg"]
    assert lines(files, "mtllib") == [["my_model.mtl"]]
    assert lines(files, "usemtl") == [["page_0"], ["page_1"]]
    for number, page in enumerate(textured_ball.texture.pages):
        assert f"newmtl page_{number}\n" in files["my_model.mtl"].decode()
        assert f"map_Kd my_model_{number}.jpg\n" in files["my_model.mtl"].decode()
        np.testing.assert_allclose(np.asarray(Image.open(io.BytesIO(files[f"my_model_{number}.jpg"]))), page, atol=4)


def test_normal_maps_are_beside_the_pages_and_the_model_is_lit(lit_ball):
    files = write_obj(lit_ball, "ball")
    assert list(files) == [
        "ball.obj", "ball.mtl", "ball_0.jpg", "ball_1.jpg", "ball_0_normals.jpg", "ball_1_normals.jpg",
    ]  # fmt: skip
    text = files["ball.mtl"].decode()
    assert text.count("illum 1\n") == 2 and "illum 0" not in text
    for number, relief in enumerate(lit_ball.texture.normal_maps):
        assert f"norm ball_{number}_normals.jpg\n" in text
        picture = Image.open(io.BytesIO(files[f"ball_{number}_normals.jpg"]))
        np.testing.assert_allclose(np.asarray(picture), relief, atol=4)


def test_without_a_texture_vertices_carry_the_colors(ball):
    files = write_obj(ball, "model")
    v = np.array(lines(files, "v"), float)
    assert list(files) == ["model.obj"]
    np.testing.assert_allclose(255 * v[:, 3:], ball.surface.colors, atol=0.02)


def test_points_and_cameras(cloud):
    files = write_obj(cloud, "model")
    assert len(lines(files, "p")) == len(cloud.surface.vertices)
    assert len(lines(files, "l")) == 8 * len(cloud.cameras)
    assert np.array(lines(files, "l"), int).max() == len(lines(files, "v"))


@pytest.mark.parametrize("size", [1e-3, 1.0, 250.0, 1e7])
def test_coordinates_are_as_exact_as_the_model_is_large(ball, size):
    surface = Surface(size * ball.surface.vertices, ball.surface.faces, ball.surface.colors)
    v = np.array(lines(write_obj(Model(surface), "model"), "v"), float)[:, :3]
    error = np.abs(v - surface.vertices).max() / size
    assert error < 10.0**-DIGITS
    assert size >= 1e7 or error > 0


def test_trimesh_and_open3d_show_both_pages(textured_ball, tmp_path):
    for name, data in write_obj(textured_ball, "my model").items():
        (tmp_path / name).write_bytes(data)
    path = tmp_path / "my model.obj"
    parts = trimesh.load_scene(path, process=False).geometry.values()
    model = load_open3d().io.read_triangle_model(str(path))
    colors = sorted(tuple(part.visual.to_color().vertex_colors[:, :3].mean(axis=0)) for part in parts)
    np.testing.assert_allclose(colors, [(30, 60, 200), (200, 40, 30)], atol=4)
    assert sum(len(part.mesh.triangles) for part in model.meshes) == len(textured_ball.surface.faces)
    assert sum(material.albedo_img is not None for material in model.materials) == 2


def test_a_ball_of_a_meter_is_closed_and_of_a_thousand_millimeters(ball):
    (data,) = write_stl(ball, "model").values()
    mesh = trimesh.load(io.BytesIO(data), file_type="stl")
    assert len(data) == 84 + 50 * len(ball.surface.faces) and not data.startswith(b"solid")
    assert mesh.is_watertight and mesh.volume > 0  # inside out, it would be below
    np.testing.assert_allclose(mesh.extents, 2000.0, rtol=1e-3)
    assert np.sum(mesh.face_normals * mesh.triangles_center, axis=1).min() > 950


def test_what_is_up_in_the_model_is_up_in_the_printer(ball):
    rows = np.frombuffer(write_stl(ball, "model")["model.stl"], "(3,)<f4,(3,3)<f4,<u2", offset=84)
    x, y, z = ball.surface.vertices[ball.surface.faces].transpose(2, 0, 1)
    np.testing.assert_allclose(rows["f1"], 1000 * np.stack([x, -z, y], axis=-1), atol=1e-3)
    np.testing.assert_allclose(np.linalg.norm(rows["f0"], axis=1), 1, atol=1e-6)


def test_corners_project_to_the_corners_of_the_photo(cloud):
    for camera in cloud.cameras:
        corners = frustum_corners(camera, 0.4)
        R, t = camera.cam_from_world[:, :3], camera.cam_from_world[:, 3]
        seen = (corners @ R.T + t) @ camera.K.T
        np.testing.assert_allclose(seen[0], 0, atol=1e-9)
        np.testing.assert_allclose(seen[1:, 2], 0.4)
        expected = [(0, 0), (640, 0), (640, 480), (0, 480)]
        np.testing.assert_allclose(seen[1:, :2] / seen[1:, 2:], expected, atol=1e-6)


def test_each_camera_is_a_pyramid_of_eight_edges(cloud):
    corners, lines = camera_lines(cloud)
    assert corners.shape == (15, 3) and lines.shape == (24, 2)
    np.testing.assert_array_equal(np.bincount(lines.ravel()).reshape(3, 5), [[4, 3, 3, 3, 3]] * 3)
    np.testing.assert_array_equal(lines // 5, np.repeat(np.arange(3), 8)[:, None] * [1, 1])


def test_dots_lie_on_the_edges(cloud):
    corners, lines = camera_lines(cloud)
    dots, colors = camera_dots(cloud)
    assert len(dots) == len(colors)
    away = [
        np.linalg.norm(np.cross(dots - corners[a], dots - corners[b]), axis=1) / np.linalg.norm(corners[a] - corners[b])
        for a, b in lines
    ]
    assert np.min(away, axis=0).max() < 1e-9


@pytest.mark.parametrize(("step", "depth"), [(1e-6, 0.0312), (0.5, 1 / 6), (100.0, 18.0)])
def test_frusta_are_seen_and_do_not_hide_the_scene(step, depth):
    """A third of a step, but 1 % to 10 % of the scene, of size 1.8 sqrt(3), or of the walk where that is longer."""
    points = np.random.default_rng(0).uniform(-1, 1, (500, 3))
    centers = step * np.array([[0.0, 0, 0], [1, 0, 0], [2, 0, 0]])
    assert frustum_depth(centers, points) == pytest.approx(depth, rel=0.05)


def test_cameras_along_the_streets_of_a_town_do_not_hide_each_other():
    walk = 0.6 * np.column_stack([np.arange(1000), np.zeros((1000, 2))])
    still = np.zeros((1000, 3))
    assert frustum_depth(walk, 0.2 * walk) == pytest.approx(0.2)
    assert 0.0 < frustum_depth(still, walk) == pytest.approx(0.9 * 600 / 3000, rel=0.01)
