import numpy as np
import pytest

from sfm_app.geometry.camera import camera_matrix
from sfm_app.geometry.rotation import nearest_rotation, rotation_distances
from sfm_app.synthetic.cameras import axis_rotation

K1, K2 = camera_matrix(700.0, 700.0, 320.0, 240.0), camera_matrix(500.0, 510.0, 300.0, 200.0)
R = axis_rotation(np.array([0.6, 0.8, 0.0]), 20.0)


def matches(moved=(0.0, 0.0, 0.0), noise=0.3):
    rng = np.random.default_rng(3)
    x1 = rng.uniform([0, 0], [640, 480], (300, 2))
    X = np.column_stack([x1, np.ones(300)]) @ np.linalg.inv(K1).T * rng.uniform(3, 9, (300, 1))
    x2 = (X @ R.T + moved) @ K2.T
    return x1 + rng.normal(scale=noise, size=(300, 2)), x2[:, :2] / x2[:, 2:]


def test_a_rotation_explains_what_a_turned_camera_sees():
    distances = rotation_distances(*matches(), K1, K2)

    assert distances.max() < 1.5
    assert np.sqrt(np.mean(distances**2) / 2) == pytest.approx(0.3 * 500 / 700, rel=0.25)


def test_mismatches_do_not_move_it():
    x1, x2 = matches()
    x2[:40] += 200.0

    distances = rotation_distances(x1, x2, K1, K2)

    assert distances[:40].min() > 150 and distances[40:].max() < 1.5


def test_a_moved_camera_is_not_explained():
    assert np.median(rotation_distances(*matches(moved=(0.5, 0.0, 0.0)), K1, K2)) > 8


def test_what_lies_behind_the_camera_is_infinitely_far():
    x1, x2 = matches()
    x1[0] = [1e6, -2e6]

    assert np.isinf(rotation_distances(x1, x2, K1, K2)[0])


def test_the_nearest_rotation_is_no_reflection():
    d = np.random.default_rng(1).normal(size=(50, 3))

    assert np.allclose(nearest_rotation(d, d @ R.T), R)
    assert np.linalg.det(nearest_rotation(d, -d)) == pytest.approx(1.0)
