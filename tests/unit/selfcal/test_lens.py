"""From pixels to rays and back."""

import numpy as np
import pytest

from sfm_app.selfcal.pairs import LEAST_SLOPE, undistort_kernel, write_camera, write_ray

F, U, V, LOG_A = 1.1, 0.03, -0.02, 0.04


def camera(k1, f=F):
    theta, out = np.array([np.log(f), U, V, LOG_A, k1 / f**2]), np.empty(5)
    write_camera(theta, out)
    return theta, out


def seen(xy, k1):
    """`write_ray` of one pixel: a, b, their four derivatives, r_u."""
    out = np.empty(7)
    write_ray(xy[0], xy[1], camera(k1)[1], -1.0, out)
    return out


def distorted(rays, k1):
    """Pixels of points (N, 2) of the plane z = 1."""
    fx, fy, u, v, _ = camera(k1)[1]
    return rays * (1 + k1 * np.sum(rays**2, axis=1, keepdims=True)) * [fx, fy] + [u, v]


def random_rays(k1, seed=0):
    reach = 0.95 * np.sqrt((1 - LEAST_SLOPE) / (3 * abs(k1))) if k1 < 0 else 2.0
    rng = np.random.default_rng(seed)
    angle, radius = rng.uniform(0, 2 * np.pi, 200), np.minimum(rng.uniform(0, 1.2, 200), reach)
    return np.column_stack([radius * np.cos(angle), radius * np.sin(angle)])


def test_parameters_are_those_of_a_camera_matrix():
    fx, fy, u, v, k1 = camera(-0.1)[1]
    assert np.sqrt(fx * fy) == pytest.approx(F)
    assert fy / fx == pytest.approx(np.exp(LOG_A))
    assert (u, v, k1) == pytest.approx((U, V, -0.1))


@pytest.mark.parametrize("k1", [-0.3, -0.1, -1e-8, 0.0, 1e-8, 0.1, 0.3, 5.0])
def test_a_lens_is_undone(k1):
    rays = random_rays(k1)
    for pixel, truth in zip(distorted(rays, k1), rays, strict=True):
        found = seen(pixel, k1)
        np.testing.assert_allclose(found[:2], truth, atol=1e-12)
        assert found[6] == pytest.approx(np.linalg.norm(truth), abs=1e-12)


@pytest.mark.parametrize("k1", [-0.3, -0.1, 0.0, 0.2])
def test_derivatives_are_those_of_differences(k1):
    step = 1e-6
    for x in np.random.default_rng(1).uniform(-0.6, 0.6, (40, 2)):
        columns = [(seen(x + move, k1)[:2] - seen(x - move, k1)[:2]) / (2 * step) for move in step * np.eye(2)]
        np.testing.assert_allclose(seen(x, k1)[2:6].reshape(2, 2), np.column_stack(columns), rtol=1e-6, atol=1e-7)


def test_at_the_center_there_is_no_lens():
    fx, fy, u, v, _ = camera(-0.3)[1]
    np.testing.assert_allclose(seen((u, v), -0.3), [0, 0, 1 / fx, 0, 0, 1 / fy, 0], atol=1e-12)


@pytest.mark.parametrize("k1", [-0.3, -3.0, -1e4])
def test_a_lens_that_would_fold_goes_on_evenly(k1):
    # points out to far beyond the fold: radii grow by 1 / LEAST_SLOPE of what they grow in the photo, without a jump
    fx, _, u, v, _ = camera(k1)[1]
    radii = np.linspace(0, 3, 3001)
    found = np.array([seen((u + fx * r, v), k1) for r in radii])
    slopes = np.diff(found[:, 0]) / np.diff(radii)
    last = np.sqrt((1 - LEAST_SLOPE) / (-3 * k1))
    beyond = radii[:-1] > last * (1 + k1 * last**2)

    assert 0.5 < np.mean(beyond) <= 1
    np.testing.assert_allclose(slopes[beyond], 1 / LEAST_SLOPE, rtol=1e-6)
    assert np.all((slopes > 0) & (slopes < 1 / LEAST_SLOPE + 1e-3))
    np.testing.assert_allclose(found[:-1][beyond, 2] * fx, 1 / LEAST_SLOPE, rtol=1e-6)


def test_how_far_points_move_does_not_depend_on_the_focal():
    points = np.random.default_rng(2).uniform(-0.5, 0.5, (50, 2))
    moves = [undistort_kernel(points, np.array([np.log(f), U, V, 0.0, -0.05])) - points for f in (0.8, 1.6)]
    np.testing.assert_allclose(moves[0], moves[1], atol=1e-12)
    assert 0.01 < np.abs(moves[0]).max() < 0.1


def test_without_a_lens_points_stay():
    points = np.random.default_rng(3).uniform(-0.5, 0.5, (50, 2))
    np.testing.assert_allclose(undistort_kernel(points, camera(0.0)[0]), points, atol=1e-15)


def test_a_first_guess_changes_nothing():
    cam, results = camera(-0.2)[1], []
    for guess in (-1.0, 0.3, 0.45, 0.6):
        out = np.empty(7)
        write_ray(0.4, 0.3, cam, guess, out)
        results.append(out)
    np.testing.assert_allclose(results, [results[0]] * 4, atol=1e-12)
