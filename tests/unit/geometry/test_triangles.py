"""Normals, edges, tangents and culling of triangles."""

import numpy as np
import pytest

from sfm_app.geometry.triangles import (
    areas,
    bucket_order,
    cluster,
    corner_angles,
    corner_tangents,
    median_edge_length,
    morton_order,
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


@pytest.fixture(scope="module")
def triangles():
    rng = np.random.default_rng(0)
    return rng.uniform(-50, 50, (20_000, 1, 3)) + rng.normal(0, 0.3, (20_000, 3, 3))


@pytest.mark.parametrize("angle_deg", [5.0, 30.0, 90.0, 150.0])
@pytest.mark.parametrize("seed", range(3))
def test_nothing_in_the_cone_is_missed(triangles, angle_deg, seed):
    rng = np.random.default_rng(seed)
    apex, axis = rng.uniform(-40, 40, 3), rng.normal(size=3)
    axis /= np.linalg.norm(axis)
    direction = triangles - apex
    cosine = direction @ axis / np.linalg.norm(direction, axis=2)
    inside = np.flatnonzero((cosine >= np.cos(np.radians(angle_deg))).any(axis=1))
    found = cluster(triangles).find_in_cone(apex, axis, np.radians(angle_deg))
    assert np.isin(inside, found).all()
    assert (np.diff(found) > 0).all()


def test_few_are_in_a_narrow_cone_and_none_behind_it(triangles):
    balls, axis = cluster(triangles), np.array([1.0, 0, 0])
    assert 0 < len(balls.find_in_cone(-150 * axis, axis, np.radians(3))) < 0.6 * len(triangles)
    assert len(balls.find_in_cone(150 * axis, axis, np.radians(30))) == 0
    nothing = np.empty((0, 3, 3))
    assert len(cluster(nothing).find_in_cone(np.zeros(3), axis, 1.0)) == len(morton_order(nothing[:, 0])) == 0


TANGENT_SQUARE = SQUARE[:4]
ONE_PAGE = np.zeros(2, np.int32)


def tangents(uv, vertices=TANGENT_SQUARE, page=ONE_PAGE):
    normals = vertex_normals(vertices, FACES)
    return corner_tangents(vertices, normals, FACES, uv.astype(np.float32), page)


def pictured(flat):
    """Texture coordinates that show a square as it is, from the top left."""
    return flat[FACES][..., :2] * [1, -1] + [0, 1]


def test_a_picture_that_lies_upright_has_the_axes_as_its_frame():
    np.testing.assert_allclose(tangents(pictured(TANGENT_SQUARE)), np.broadcast_to([1, 0, 0, 1], (2, 3, 4)), atol=1e-7)


def test_a_mirrored_picture_has_its_right_on_the_left_and_still_its_up_on_top():
    found = tangents(1.0 - pictured(TANGENT_SQUARE) * [1, -1] - [0, 1])  # left and right exchanged
    np.testing.assert_allclose(found, np.broadcast_to([-1, 0, 0, -1], (2, 3, 4)), atol=1e-7)
    np.testing.assert_allclose(
        found[..., 3:] * np.cross([0, 0, 1], found[..., :3]), np.broadcast_to([0, 1, 0], (2, 3, 3))
    )


def test_corners_share_a_tangent_where_they_share_vertex_place_and_page():
    bent = np.column_stack([TANGENT_SQUARE[:, :2], [0, 0.3, 0, -0.2]])
    uv = pictured(TANGENT_SQUARE) * [1, 0.7] + np.array([[[0, 0]] * 3, [[0.1, 0], [0, 0.05], [0, 0]]])
    joined, parted = tangents(pictured(TANGENT_SQUARE), bent), tangents(uv, bent)
    on_pages = tangents(pictured(TANGENT_SQUARE), bent, np.array([0, 1], np.int32))
    np.testing.assert_array_equal(joined[0, [0, 2]], joined[1, [0, 1]])
    assert (parted[0, 0] != parted[1, 0]).any()
    assert (on_pages[0, 0] != on_pages[1, 0]).any()
    normals = vertex_normals(bent, FACES)[FACES]
    for found in (joined, parted, on_pages):
        np.testing.assert_allclose(np.linalg.norm(found[..., :3], axis=2), 1, atol=1e-6)
        np.testing.assert_allclose(np.sum(found[..., :3] * normals, axis=2), 0, atol=1e-6)


@pytest.mark.parametrize("uv", [np.zeros((2, 3, 2)), np.full((2, 3, 2), 0.5) * [[0], [1], [2]]], ids=["point", "line"])
def test_a_texture_without_area_still_has_unit_tangents(uv):
    found = tangents(uv)
    np.testing.assert_allclose(np.linalg.norm(found[..., :3], axis=2), 1, atol=1e-6)
    np.testing.assert_allclose(found[..., 2], 0, atol=1e-6)


def test_angles_of_triangles():
    np.testing.assert_allclose(np.degrees(corner_angles(TANGENT_SQUARE[FACES])), [[45, 90, 45], [45, 45, 90]])


def test_the_morton_order_keeps_near_points_together():
    points = np.random.default_rng(4).uniform(-3, 5, (2000, 3))
    steps = np.linalg.norm(np.diff(points[morton_order(points)], axis=0), axis=1)
    assert np.median(steps) < 0.15 * np.median(np.linalg.norm(np.diff(points, axis=0), axis=1))
