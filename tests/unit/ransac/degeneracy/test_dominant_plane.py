"""The plane that holds most of the inliers is found, among other structure and with any epipole."""

import numpy as np
import pytest

from sfm_app.camera.models import camera_matrix
from sfm_app.fundamental.degeneracy import dominant_homography, transfer_distance
from sfm_app.fundamental.estimate import judge
from sfm_app.geometry.epipolar import fundamental_from_pose
from sfm_app.settings import EpipolarSettings
from sfm_app.synthetic.correspondences import random_rotation

FOCAL, SIZE = 900.0, np.array([1024.0, 768.0])
K = camera_matrix(FOCAL, FOCAL, *(SIZE / 2))
UNIT = 400.0


def mapped(H, x):
    h = np.column_stack([x, np.ones(len(x))]) @ H.T
    return h[:, :2] / h[:, 2:]


def scene(seed, *, on_plane, off_plane, sigma_px):
    """Matches of one plane and after them at other depths, H of the plane and F; lengths in units of 400 px."""
    rng = np.random.default_rng([seed, 3])
    R, t, n = random_rotation(rng, 20.0), rng.normal(0, 0.3, 3), rng.normal((0, 0, -1), 0.2)
    x1 = rng.uniform(-1, 1, (on_plane + off_plane, 2))
    k = np.diag([FOCAL / UNIT, FOCAL / UNIT, 1.0])
    rays = np.column_stack([x1, np.ones(len(x1))]) @ np.linalg.inv(k).T
    depth = -1 / (rays @ n)
    depth[on_plane:] *= rng.uniform(1.2, 2.0, off_plane)
    x2 = ((rays * depth[:, None]) @ R.T + t) @ k.T
    points = np.column_stack([x1, x2[:, :2] / x2[:, 2:]]) + rng.normal(0, sigma_px / UNIT, (len(x1), 4))
    H = k @ (R - np.outer(t, n)) @ np.linalg.inv(k)
    return np.asfortranarray(points), H, fundamental_from_pose(k, k, R, t)


@pytest.mark.parametrize(("on_plane", "off_plane"), [(100, 0), (100, 60), (300, 280), (10, 4)])
@pytest.mark.parametrize("seed", range(4))
def test_the_plane_is_found_among_other_structure(seed, on_plane, off_plane):
    points, H, F = scene(seed, on_plane=on_plane, off_plane=off_plane, sigma_px=0.0)
    order = np.random.default_rng(seed).permutation(len(points))

    found = dominant_homography(np.asfortranarray(points[order]), F, 1.5 / UNIT)

    np.testing.assert_allclose(found / found[2, 2], H / H[2, 2], atol=1e-7)
    on = transfer_distance(found, points) * UNIT < 1.5
    assert on[:on_plane].all()
    assert on[on_plane:].mean() < 0.1 if off_plane else True


@pytest.mark.parametrize("seed", range(6))
def test_noise_moves_the_plane_by_less_than_itself(seed):
    points, H, F = scene(seed, on_plane=200, off_plane=100, sigma_px=0.5)
    found = dominant_homography(points, F, 1.5 / UNIT)
    exact = np.column_stack([points[:200, :2], mapped(H, points[:200, :2])])
    assert 0 < np.median(transfer_distance(found, exact)) * UNIT < 0.5


def test_an_epipole_among_the_matches_does_not_spoil_the_plane():
    """The equations of matches beside the epipole are all noise: unweighted, the error would be 1.6 px here."""
    errors = []
    for seed in range(30):
        points, H, _ = scene(seed, on_plane=200, off_plane=0, sigma_px=0.5)
        rng = np.random.default_rng(seed)
        e2 = np.append(points[rng.integers(200), 2:] + rng.normal(0, 2 / UNIT, 2), 1.0)
        found = dominant_homography(points, np.cross(np.eye(3), e2) @ H, 1.5 / UNIT)
        exact = np.column_stack([points[:, :2], mapped(H, points[:, :2])])
        errors.append(transfer_distance(found, exact).max() * UNIT)
    assert 0.05 < np.median(errors) < 0.4
    assert max(errors) < 2


def test_transfer_distance_by_hand():
    H = np.array([[1.0, 0, 3], [0, 1, 4], [0, 0, 1]])
    points = np.asfortranarray([[0, 0, 3, 4.0], [0, 0, 0, 0], [5, 5, 8, 10]])
    np.testing.assert_allclose(transfer_distance(H, points), [0, 5 / np.sqrt(2), 1 / np.sqrt(2)])
    to_infinity = np.array([[1.0, 0, 0], [0, 1, 0], [1, 0, 0]])
    assert transfer_distance(to_infinity, points)[0] == np.inf


def test_matches_on_one_line_have_no_single_plane_and_still_get_an_answer():
    t = np.linspace(-1, 1, 40)
    points = np.asfortranarray(np.column_stack([t, 0.3 * t, 0.5 * t + 0.1, 0.2 * t]))
    F = scene(0, on_plane=8, off_plane=0, sigma_px=0)[2]
    assert np.isfinite(dominant_homography(points, F, 0.01)).all()


@pytest.mark.parametrize("kind", ["rotation", "planar"])
def test_every_wrong_epipole_on_a_homography_is_seen_through(kind):
    """F = [e]x H for any e, also one among the points, where the plane's equations are all noise."""
    silent, judged = [], 0
    for seed in range(100):
        rng = np.random.default_rng([seed, 77])
        x1 = rng.uniform((0, 0), SIZE, (2000, 2))
        R, t, n = random_rotation(rng, 25.0), rng.normal(0, 0.3, 3), rng.normal((0, 0, -1), 0.3)
        H = K @ (R if kind == "rotation" else R - np.outer(t, n)) @ np.linalg.inv(K)
        x2 = mapped(H, x1)
        seen = ((x2 > 0) & (x2 < SIZE)).all(axis=1)
        if np.count_nonzero(seen) < 100:
            continue
        x1, x2 = (x[seen][:400] + rng.normal(0, 0.5, x[seen][:400].shape) for x in (x1, x2))
        e2 = rng.uniform(-0.5, 1.5, 2) * SIZE if seed % 2 else x2[rng.integers(len(x2))] + rng.normal(0, 2.0, 2)
        F = np.cross(np.eye(3), np.append(e2, 1.0)) @ H
        fit = judge(x1, x2, F, EpipolarSettings(max_error_px=2.0))
        judged += bool(fit)
        if fit and not fit.degeneracy:
            silent.append(seed)
    assert judged > 90
    assert silent == []
