"""Frames along a texture."""

import numpy as np
import pytest

from sfm_app.geometry.triangles import corner_angles, corner_tangents, vertex_normals

SQUARE = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
FACES = np.array([[0, 1, 2], [0, 2, 3]])
ONE_PAGE = np.zeros(2, np.int32)


def tangents(uv, vertices=SQUARE, page=ONE_PAGE):
    normals = vertex_normals(vertices, FACES)
    return corner_tangents(vertices, normals, FACES, uv.astype(np.float32), page)


def pictured(flat):
    """Texture coordinates that show a square as it is, from the top left."""
    return flat[FACES][..., :2] * [1, -1] + [0, 1]


def test_a_picture_that_lies_upright_has_the_axes_as_its_frame():
    np.testing.assert_allclose(tangents(pictured(SQUARE)), np.broadcast_to([1, 0, 0, 1], (2, 3, 4)), atol=1e-7)


def test_a_mirrored_picture_has_its_right_on_the_left_and_still_its_up_on_top():
    found = tangents(1.0 - pictured(SQUARE) * [1, -1] - [0, 1])  # left and right exchanged

    np.testing.assert_allclose(found, np.broadcast_to([-1, 0, 0, -1], (2, 3, 4)), atol=1e-7)
    np.testing.assert_allclose(
        found[..., 3:] * np.cross([0, 0, 1], found[..., :3]), np.broadcast_to([0, 1, 0], (2, 3, 3))
    )


def test_corners_share_a_tangent_where_they_share_vertex_place_and_page():
    bent = np.column_stack([SQUARE[:, :2], [0, 0.3, 0, -0.2]])
    uv = pictured(SQUARE) * [1, 0.7] + np.array([[[0, 0]] * 3, [[0.1, 0], [0, 0.05], [0, 0]]])
    joined, parted = tangents(pictured(SQUARE), bent), tangents(uv, bent)
    on_pages = tangents(pictured(SQUARE), bent, np.array([0, 1], np.int32))

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
    np.testing.assert_allclose(np.degrees(corner_angles(SQUARE[FACES])), [[45, 90, 45], [45, 45, 90]])
