"""Triangles in space."""

import numpy as np

from sfm_app.geometry.triangles import (
    areas,
    bucket_order,
    median_edge_length,
    number_vertices,
    unique_edges,
    vertex_normals,
)

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


def test_edges_come_in_order_and_normals_add_up_for_any_triangles():
    rng = np.random.default_rng(3)
    vertices, faces = rng.normal(size=(40, 3)), rng.integers(0, 40, (300, 3))
    edges, edge_of = unique_edges(faces)

    sides = np.sort(np.stack([faces, np.roll(faces, -1, axis=1)], axis=2), axis=2)
    np.testing.assert_array_equal(edges, np.unique(sides.reshape(-1, 2), axis=0))
    np.testing.assert_array_equal(edges[edge_of], sides)
    total = np.zeros((40, 3))
    corners = vertices[faces]
    for k in range(3):
        np.add.at(total, faces[:, k], np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]))
    expected = total / np.linalg.norm(total, axis=1, keepdims=True)
    np.testing.assert_allclose(vertex_normals(vertices, faces), expected, atol=1e-12)


def test_bucket_order_is_that_of_a_stable_sort():
    keys = np.random.default_rng(4).integers(0, 50, 1000)

    np.testing.assert_array_equal(bucket_order(keys, 50), np.argsort(keys, kind="stable"))
    assert len(bucket_order(np.empty(0, np.int64), 0)) == 0


def test_used_vertices_are_numbered_in_order():
    used, faces = number_vertices(np.array([[7, 2, 9], [2, 9, 4]], np.int32))

    np.testing.assert_array_equal(used, [2, 4, 7, 9])
    np.testing.assert_array_equal(faces, [[2, 0, 3], [0, 3, 1]])
    assert [len(part) for part in number_vertices(np.empty((0, 3), np.int64))] == [0, 0]
