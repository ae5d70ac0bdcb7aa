"""Pose and camera of a photo."""

import numpy as np
import pytest

from sfm_app.synthetic.cameras import look_at
from sfm_app.types import PosedPhoto

CENTER = np.array([1.0, 2.0, 5.0])
POINT = np.array([0.2, 0.1, -0.3])


@pytest.fixture
def photo():
    """A photo that looks at the origin."""
    K = np.array([[100.0, 0.5, 42], [0, 110, 29], [0, 0, 1]])
    return PosedPhoto("a.jpg", K, look_at(CENTER, np.zeros(3)), 80, 60)


def test_the_center_sees_the_origin_along_the_axis(photo):
    np.testing.assert_allclose(photo.center, CENTER, atol=1e-12)
    np.testing.assert_allclose(photo.axis, -CENTER / np.linalg.norm(CENTER), atol=1e-12)
    assert photo.depths(np.zeros((1, 3)))[0] == pytest.approx(np.linalg.norm(CENTER))


def test_the_projection_and_the_camera_agree(photo):
    x, y, depth = photo.projection @ [*POINT, 1.0]

    np.testing.assert_allclose(np.linalg.solve(photo.K, [x, y, depth]), photo.R @ (POINT - CENTER))
    assert depth == pytest.approx(photo.depths(POINT[None])[0])
    assert photo.focal_px == pytest.approx(np.sqrt(100 * 110))


def test_a_smaller_photo_shows_the_same(photo):
    small = photo.resize(40, 20)

    assert (small.name, small.width, small.height) == ("a.jpg", 40, 20)
    full, less = (one.projection @ [*POINT, 1.0] for one in (photo, small))
    np.testing.assert_allclose(less / less[2], full / full[2] * [40 / 80, 20 / 60, 1])
    np.testing.assert_array_equal(small.center, photo.center)


def test_the_widest_angle_is_that_of_the_corners():
    photo = PosedPhoto("", np.array([[100.0, 0, 40], [0, 100, 30], [0, 0, 1]]), np.eye(3, 4), 80, 60)

    assert np.degrees(photo.widest_angle) == pytest.approx(np.degrees(np.arctan(0.5)), abs=1.0)
    assert photo.widest_angle > np.arctan(0.5)
