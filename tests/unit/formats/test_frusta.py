"""Cameras drawn into a scene."""

from dataclasses import replace

import numpy as np
import pytest

from sfm_app.formats.frusta import camera_dots, camera_lines, frustum_corners, frustum_depth
from sfm_app.types import Surface


def test_corners_project_to_the_corners_of_the_photo(cloud):
    for camera in cloud.cameras:
        corners = frustum_corners(camera, 0.4)
        R, t = camera.cam_from_world[:, :3], camera.cam_from_world[:, 3]
        seen = (corners @ R.T + t) @ camera.K.T

        np.testing.assert_allclose(seen[0], 0, atol=1e-9)
        np.testing.assert_allclose(seen[1:, 2], 0.4)
        expected = [(0, 0), (640, 0), (640, 480), (0, 480)]
        np.testing.assert_allclose(seen[1:, :2] / seen[1:, 2:], expected, atol=1e-6)


def test_each_camera_is_a_pyramid_of_eight_edges(cloud):
    corners, lines = camera_lines(cloud)
    assert corners.shape == (15, 3) and lines.shape == (24, 2)
    np.testing.assert_array_equal(np.bincount(lines.ravel()).reshape(3, 5), [[4, 3, 3, 3, 3]] * 3)
    np.testing.assert_array_equal(lines // 5, np.repeat(np.arange(3), 8)[:, None] * [1, 1])


def test_dots_lie_on_the_edges(cloud):
    corners, lines = camera_lines(cloud)
    dots, colors = camera_dots(cloud)

    assert len(dots) == len(colors)
    away = [
        np.linalg.norm(np.cross(dots - corners[a], dots - corners[b]), axis=1) / np.linalg.norm(corners[a] - corners[b])
        for a, b in lines
    ]
    assert np.min(away, axis=0).max() < 1e-9


@pytest.mark.parametrize(("step", "depth"), [(1e-6, 0.0312), (0.5, 1 / 6), (100.0, 18.0)])
def test_frusta_are_seen_and_do_not_hide_the_scene(step, depth):
    """A third of a step, but 1 % to 10 % of the scene, of size 1.8 sqrt(3), or of the walk where that is longer."""
    points = np.random.default_rng(0).uniform(-1, 1, (500, 3))
    centers = step * np.array([[0.0, 0, 0], [1, 0, 0], [2, 0, 0]])
    assert frustum_depth(centers, points) == pytest.approx(depth, rel=0.05)


def test_cameras_along_the_streets_of_a_town_do_not_hide_each_other():
    walk = 0.6 * np.column_stack([np.arange(1000), np.zeros((1000, 2))])
    still = np.zeros((1000, 3))
    assert frustum_depth(walk, 0.2 * walk) == pytest.approx(0.2)
    assert 0.0 < frustum_depth(still, walk) == pytest.approx(0.9 * 600 / 3000, rel=0.01)


def test_without_cameras_there_is_nothing(ball):
    assert [len(part) for part in (*camera_lines(ball), *camera_dots(ball))] == [0, 0, 0, 0]


def test_one_camera_at_one_point_has_a_size(cloud):
    point = Surface(np.zeros((1, 3)), cloud.surface.faces, cloud.surface.colors[:1])
    still = replace(cloud.cameras[0], cam_from_world=np.eye(3, 4))
    corners, _ = camera_lines(replace(cloud, surface=point, cameras=(still,)))
    assert np.isfinite(corners).all() and np.ptp(corners, axis=0).min() > 0
