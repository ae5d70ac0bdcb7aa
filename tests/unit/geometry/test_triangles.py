"""Triangles in space."""

import numpy as np

from sfm_app.geometry.triangles import areas, median_edge_length, unique_edges, vertex_normals

SQUARE = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [1.0, 1.0, 0.0], [0.0, 1.0, 0.0], [5.0, 5.0, 5.0]])
FACES = np.array([[0, 1, 2], [0, 2, 3]])


def test_normals_stand_on_the_surface_where_there_is_one():
    np.testing.assert_allclose(vertex_normals(SQUARE, FACES)[:4], np.broadcast_to([0.0, 0.0, 1.0], (4, 3)))
    np.testing.assert_allclose(vertex_normals(SQUARE, FACES[:, ::-1])[:4], np.broadcast_to([0.0, 0.0, -1.0], (4, 3)))
    np.testing.assert_array_equal(vertex_normals(SQUARE, FACES)[4], 0.0)


def test_edges_are_listed_once_with_those_of_each_triangle():
    edges, edge_of = unique_edges(FACES)

    assert {tuple(edge) for edge in edges} == {(0, 1), (1, 2), (0, 2), (2, 3), (0, 3)}
    for face, of_face in zip(FACES, edge_of, strict=True):
        for corner in range(3):
            assert set(edges[of_face[corner]]) == {face[corner], face[(corner + 1) % 3]}


def test_sizes_and_nothing_at_all():
    np.testing.assert_allclose(areas(2 * SQUARE, FACES), [2.0, 2.0])
    assert median_edge_length(3 * SQUARE, FACES) == 3.0
    assert [len(part) for part in unique_edges(np.empty((0, 3), np.int64))] == [0, 0]
