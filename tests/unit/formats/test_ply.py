"""PLY files, read back."""

import io

import numpy as np
import trimesh

from sfm_app.formats.frusta import CAMERA_COLOR, DOTS
from sfm_app.formats.meshes import write_ply
from sfm_app.meshing.ray_casting import load_open3d


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


def test_open3d_reads_surface_and_points(ball, cloud, tmp_path):
    o3d = load_open3d()
    for model in (ball, cloud):
        (tmp_path / "model.ply").write_bytes(write_ply(model, "model")["model.ply"])
        mesh = o3d.io.read_triangle_mesh(str(tmp_path / "model.ply"))
        points = o3d.io.read_point_cloud(str(tmp_path / "model.ply"))

        np.testing.assert_array_equal(np.asarray(mesh.triangles), model.surface.faces)
        assert mesh.has_vertex_normals() == bool(len(model.surface.faces))
        count = len(model.surface.vertices)
        np.testing.assert_allclose(np.asarray(points.points)[:count], model.surface.vertices, atol=1e-6)
        np.testing.assert_allclose(255 * np.asarray(points.colors)[:count], model.surface.colors, atol=0.01)
