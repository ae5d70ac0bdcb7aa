"""The plane of a ground, of which the photos may know little."""

import numpy as np
import pytest

from sfm_app.frame.up_direction import dominant_plane

UP = np.array([0.0, 1.0, 0.0])


@pytest.mark.parametrize("seed", [0, 3, 12, 18])
def test_points_without_noise_give_a_plane_without_deviation(seed):
    rng = np.random.default_rng(seed)
    across, slope = rng.uniform(-3, 3, (60, 2)), rng.uniform(-0.1, 0.1, 2)
    points = np.column_stack([across[:, 0], 1.5 + across @ slope, across[:, 1]])

    plane = dominant_plane(points, UP, (0.0, 20.0))

    assert plane.share == 1.0 and 0.0 <= plane.deviation_deg < 1e-6
    assert plane.normal == pytest.approx(np.array([-slope[0], 1.0, -slope[1]]) / np.hypot(1.0, np.hypot(*slope)))


@pytest.mark.parametrize("points", [np.zeros((0, 3)), np.zeros((40, 3)), np.linspace(0.0, 1.0, 40)[:, None] * UP])
def test_no_points_one_place_and_a_line_have_no_plane(points):
    assert dominant_plane(points, UP, (0.0, 20.0)) is None
