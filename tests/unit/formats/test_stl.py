"""STL files, read back."""

import io

import numpy as np
import pytest
import trimesh

from sfm_app.errors import ReconstructionError
from sfm_app.formats.meshes import write_stl


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


def test_points_have_no_stl(cloud):
    with pytest.raises(ReconstructionError, match="triangles only"):
        write_stl(cloud, "model")
