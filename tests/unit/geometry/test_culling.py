"""What a camera can have in view is never missed, and most of the rest is never looked at."""

import numpy as np
import pytest

from sfm_app.geometry.triangles import border_angle, cluster, morton_order


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
    way = triangles - apex
    cosine = way @ axis / np.linalg.norm(way, axis=2)
    inside = np.flatnonzero((cosine >= np.cos(np.radians(angle_deg))).any(axis=1))

    found = cluster(triangles).find_in_cone(apex, axis, np.radians(angle_deg))

    assert np.isin(inside, found).all()
    assert (np.diff(found) > 0).all()


def test_a_narrow_cone_looks_at_few(triangles):
    found = cluster(triangles).find_in_cone(np.array([-150.0, 0, 0]), np.array([1.0, 0, 0]), np.radians(3))

    assert 0 < len(found) < 0.6 * len(triangles)


def test_nothing_is_in_view_of_a_camera_that_looks_away(triangles):
    assert len(cluster(triangles).find_in_cone(np.array([150.0, 0, 0]), np.array([1.0, 0, 0]), np.radians(30))) == 0


def test_of_nothing_nothing_is_seen():
    found = cluster(np.empty((0, 3, 3))).find_in_cone(np.zeros(3), np.array([0, 0, 1.0]), 1.0)

    assert len(found) == len(morton_order(np.empty((0, 3)))) == 0


def test_the_border_of_a_photo_is_that_of_its_corners():
    K = np.array([[100.0, 0, 40], [0, 100, 30], [0, 0, 1]])

    assert np.degrees(border_angle(K, 80, 60)) == pytest.approx(np.degrees(np.arctan(0.5)), abs=1.0)
    assert border_angle(K, 80, 60) > np.arctan(0.5)


def test_the_morton_order_keeps_near_points_together():
    points = np.random.default_rng(4).uniform(-3, 5, (2000, 3))
    steps = np.linalg.norm(np.diff(points[morton_order(points)], axis=0), axis=1)
    assert np.median(steps) < 0.15 * np.median(np.linalg.norm(np.diff(points, axis=0), axis=1))
