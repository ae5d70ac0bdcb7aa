"""Sharpness of photos, and views by photo and triangle."""

import cv2
import numpy as np
import pytest
from painted_box import sightings

from sfm_app.texture.sightings import NONE, sharpness, sharpness_factors


def test_blur_lowers_sharpness():
    rng = np.random.default_rng(0)
    noise = cv2.GaussianBlur(rng.integers(0, 255, (200, 300, 3), np.uint8), (0, 0), 0.8)
    blurred = cv2.GaussianBlur(noise, (0, 0), 2.0)
    found = np.array([sharpness(noise), sharpness(noise[:, 50:]), sharpness(blurred)])
    factors = sharpness_factors(found)
    assert factors[2] < 0.5 * factors[0]
    assert factors[1] == pytest.approx(factors[0], rel=0.1)


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
