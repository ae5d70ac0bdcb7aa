"""Triangles in space."""

import numpy as np

from sfm_app.geometry.triangles import vertex_normals

SQUARE = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [1.0, 1.0, 0.0], [0.0, 1.0, 0.0], [5.0, 5.0, 5.0]])
FACES = np.array([[0, 1, 2], [0, 2, 3]])


def test_normals_stand_on_the_surface_where_there_is_one():
    np.testing.assert_allclose(vertex_normals(SQUARE, FACES)[:4], np.broadcast_to([0.0, 0.0, 1.0], (4, 3)))
    np.testing.assert_allclose(vertex_normals(SQUARE, FACES[:, ::-1])[:4], np.broadcast_to([0.0, 0.0, -1.0], (4, 3)))
    np.testing.assert_array_equal(vertex_normals(SQUARE, FACES)[4], 0.0)
