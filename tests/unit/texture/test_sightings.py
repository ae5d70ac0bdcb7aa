"""Sharpness of photos, and views by photo and triangle."""

import cv2
import numpy as np
import pytest
from painted_box import around, box, sightings

from sfm_app.texture.sightings import NONE, facets, score_faces, sharpness, sharpness_factors
from sfm_app.texture.views import project
from sfm_app.types import Surface


def test_blur_lowers_sharpness():
    rng = np.random.default_rng(0)
    noise = cv2.GaussianBlur(rng.integers(0, 255, (200, 300, 3), np.uint8), (0, 0), 0.8)
    blurred = cv2.GaussianBlur(noise, (0, 0), 2.0)
    found = np.array([sharpness(noise), sharpness(noise[:, 50:]), sharpness(blurred)])
    factors = sharpness_factors(found)
    assert factors[2] < 0.5 * factors[0]
    assert factors[1] == pytest.approx(factors[0], rel=0.1)


def test_masked_pixels_do_not_change_the_sharpness():
    rng = np.random.default_rng(0)
    photo, used = rng.integers(0, 255, (60, 80, 3), np.uint8), np.ones((60, 80), np.bool_)
    used[20:33, 31:50] = False
    other = np.where(used[..., None], photo, np.uint8(255))

    assert sharpness(photo, used) == sharpness(other, used) != sharpness(photo)


def test_triangles_behind_others_have_no_view_and_those_beside_outlines_a_lower_score():
    """A board, of the same depth everywhere, stands before a part of a box."""
    view, shape = around(2, size=(1600, 1200), k1=0.0)[0], box(160)
    middle, depth = np.array([803.4, 561.7, 1.0]), 2.0
    corners = middle + np.array([[-90, -70, 0], [-90, 70, 0], [90, 70, 0], [90, -70, 0]])
    board = view.center + depth * corners @ np.linalg.inv(view.K).T @ view.R
    faces = np.concatenate([shape.faces, len(shape.vertices) + np.array([[0, 1, 2], [0, 2, 3]])])
    both = Surface(np.concatenate([shape.vertices, board]), faces, np.zeros((len(shape.vertices) + 4, 3), np.uint8))
    photo = np.full((1200, 1600, 3), 100, np.uint8)

    whole, behind = (score_faces(view, photo, None, facets(surface)) for surface in (shape, both))

    rest = behind.face < len(shape.faces)
    score = dict(zip(behind.face[rest].tolist(), behind.score[rest], strict=True))
    places = shape.vertices[shape.faces[whole.face]]
    pixels = np.array([[project(view.row, *place)[:2] for place in (*three, three.mean(axis=0))] for three in places])
    within = np.array([90.0, 70.0]) - np.abs(pixels - middle[:2])  # of the board; negative beside it
    inside, outside = within.min(axis=2), -within.min(axis=2)
    ratio = np.array([score.get(face, 0.0) for face in whole.face.tolist()]) / whole.score
    assert not ratio[(inside > 1.0).all(axis=1)].any()
    assert (inside > 1.0).all(axis=1).sum() > 20
    np.testing.assert_array_equal(ratio[(outside > 6.0).all(axis=1)], 1.0)
    beside = (outside > 0.8).all(axis=1) & (outside < 3.0).any(axis=1)
    np.testing.assert_allclose(ratio[beside & (ratio < 1.0)], 0.25, rtol=1e-6)
    assert np.mean(ratio[beside] == 0.25) > 0.9
    assert beside.sum() > 10


@pytest.mark.parametrize(("half_px", "seen"), [(60.0, False), (6.0, True)])
def test_a_large_triangle_with_an_object_between_its_corners_has_no_view(half_px, seen):
    """The object hides neither the corners nor the center; a small one does not matter."""
    view = around(2, size=(1600, 1200), k1=0.0)[0]
    board = np.array([550.0, 360.0]) + half_px * np.array([[-1, -1], [-1, 1], [1, 1], [1, -1]])
    pixels = np.concatenate([[[300.0, 200.0], [800.0, 1000.0], [1300.0, 300.0]], board])
    rays = np.column_stack([pixels, np.ones(7)]) @ np.linalg.inv(view.K).T @ view.R
    vertices = view.center + rays * np.array([3.0] * 3 + [2.0] * 4)[:, None]
    faces = np.array([[0, 1, 2], [3, 4, 5], [3, 5, 6]])
    photo = np.full((1200, 1600, 3), 100, np.uint8)

    found = score_faces(view, photo, None, facets(Surface(vertices, faces, np.zeros((7, 3), np.uint8))))

    assert (0 in found.face) == seen
    assert {1, 2} <= set(found.face.tolist())


def test_views_are_found_by_photo_and_triangle():
    score = np.array([[0, 2, 0, 5.0], [1, 0, 0, -3], [0, 0, 0, 0]])
    seen = sightings(score)
    photo, face = (part.ravel() for part in np.indices(score.shape))

    rows = seen.find(photo, face)
    np.testing.assert_array_equal(rows != NONE, score.ravel() != 0)
    np.testing.assert_array_equal(seen.score[rows[rows != NONE]], score.ravel()[rows != NONE])
    np.testing.assert_array_equal(seen.is_usable(photo, face), score.ravel() > 0)
    assert seen.find(0, np.array([NONE, 3])).tolist() == [NONE, 1]
    part = seen.select_triangles(np.array([False, True, False, True]))
    assert (part.photos, part.triangles, part.face.tolist()) == (3, 2, [0, 1, 1])
    assert part.face_rows.tolist() == [0, 1, 2]
