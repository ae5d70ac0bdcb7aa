"""Pairs as calibrators take them, and the lens."""

import numpy as np
import pytest

from sfm_app.geometry.epipolar import sampson_distance
from sfm_app.selfcal import pair_weights
from sfm_app.selfcal.calibrate_pairs import undistort_pairs
from sfm_app.selfcal.pairs import LEAST_SLOPE, prepare, undistort_kernel, write_camera, write_ray
from sfm_app.synthetic.correspondences import TrackOptions, make_tracks
from sfm_app.types import Calibration, CameraPairs

FRAME = {"unit_px": 1000.0, "origin_px": (500.0, 375.0)}


def test_weights_rise_with_the_inliers_up_to_one():
    np.testing.assert_allclose(pair_weights([0, 150, 300, 9000]), [0, 0.5, 1, 1])


def test_epipolar_geometry_survives_the_change_of_units(views):
    made = views(3, noise=0.0)
    pairs = prepare(CameraPairs.from_Fs(made.Fs, made.size, made.weights), **FRAME)
    to_units = np.array([[1e-3, 0, -0.5], [0, 1e-3, -0.375], [0, 0, 1]])
    rng = np.random.default_rng(0)
    x1, x2 = (np.column_stack([rng.uniform(0, 700, (20, 2)), np.ones(20)]) for _ in range(2))
    in_px = np.einsum("ni,pij,nj->pn", x2, made.Fs, x1)
    in_units = np.einsum("ni,pij,nj->pn", x2 @ to_units.T, pairs.F, x1 @ to_units.T)
    scale = in_units / in_px  # one per pair
    np.testing.assert_allclose(scale, np.broadcast_to(scale[:, :1], scale.shape), rtol=1e-6)


def test_parts_belong_to_the_matrix(views):
    made = views(4, noise=0.05)
    pairs = prepare(CameraPairs.from_Fs(made.Fs, made.size, made.weights), **FRAME)
    s = np.linalg.svd(pairs.F, compute_uv=False)
    assert len(pairs) == 6
    assert np.all(s[:, 2] < 1e-15)
    np.testing.assert_allclose(pairs.product, s[:, 0] * s[:, 1])
    np.testing.assert_allclose(np.einsum("pij,pj->pi", pairs.F, pairs.e1), 0, atol=1e-15)
    np.testing.assert_allclose(np.einsum("pij,pi->pj", pairs.F, pairs.e2), 0, atol=1e-15)
    np.testing.assert_allclose(np.linalg.norm(pairs.e1, axis=1), 1)
    np.testing.assert_allclose(np.linalg.norm(pairs.e2, axis=1), 1)


def test_pairs_without_weight_are_left_out_and_repeated_ones_count_once(views):
    made = views(3)
    np.testing.assert_array_equal(
        prepare(CameraPairs.from_Fs(made.Fs, made.size, [1.0, 0, 0.5]), **FRAME).weights, [1, 0.5]
    )
    Fs = np.concatenate([made.Fs, -3 * made.Fs, made.Fs.transpose(0, 2, 1), 1e9 * made.Fs])
    pairs = prepare(CameraPairs.from_Fs(Fs, made.size, np.arange(1.0, 13)), **FRAME)
    np.testing.assert_array_equal(pairs.weights, [1, 2, 3])
    near = made.Fs + 1e-6 * np.abs(made.Fs).max()
    assert len(prepare(CameraPairs.from_Fs(near, made.size, made.weights), **FRAME)) == 3


F = np.eye(3)[None]


FOCAL, U, V, LOG_A = 1.1, 0.03, -0.02, 0.04


def camera(k1, f=FOCAL):
    theta, out = np.array([np.log(f), U, V, LOG_A, k1 / f**2]), np.empty(5)
    write_camera(theta, out)
    return theta, out


def ray_of(xy, k1):
    """`write_ray` of one pixel: a, b, da/dx, da/dy, db/dx, db/dy, r_u."""
    out = np.empty(10)
    write_ray(xy[0], xy[1], camera(k1)[1], -1.0, out)
    return out[[0, 1, 3, 6, 4, 7, 9]]


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
    assert np.sqrt(fx * fy) == pytest.approx(FOCAL)
    assert fy / fx == pytest.approx(np.exp(LOG_A))
    assert (u, v, k1) == pytest.approx((U, V, -0.1))


@pytest.mark.parametrize("k1", [-0.3, -0.1, -1e-8, 0.0, 1e-8, 0.1, 0.3, 5.0])
def test_a_lens_is_undone(k1):
    rays = random_rays(k1)
    for pixel, truth in zip(distorted(rays, k1), rays, strict=True):
        found = ray_of(pixel, k1)
        np.testing.assert_allclose(found[:2], truth, atol=1e-12)
        assert found[6] == pytest.approx(np.linalg.norm(truth), abs=1e-12)


@pytest.mark.parametrize("k1", [-0.3, -0.1, 0.0, 0.2])
def test_derivatives_are_those_of_differences(k1):
    step = 1e-6
    for x in np.random.default_rng(1).uniform(-0.6, 0.6, (40, 2)):
        columns = [(ray_of(x + move, k1)[:2] - ray_of(x - move, k1)[:2]) / (2 * step) for move in step * np.eye(2)]
        np.testing.assert_allclose(ray_of(x, k1)[2:6].reshape(2, 2), np.column_stack(columns), rtol=1e-6, atol=1e-7)


def test_at_the_center_there_is_no_lens():
    fx, fy, u, v, _ = camera(-0.3)[1]
    np.testing.assert_allclose(ray_of((u, v), -0.3), [0, 0, 1 / fx, 0, 0, 1 / fy, 0], atol=1e-12)


@pytest.mark.parametrize("k1", [-0.3, -3.0, -1e4])
def test_a_lens_that_would_fold_goes_on_evenly(k1):
    # points out to far beyond the fold: radii grow by 1 / LEAST_SLOPE of what they grow in the photo, without a jump
    fx, _, u, v, _ = camera(k1)[1]
    radii = np.linspace(0, 3, 3001)
    found = np.array([ray_of((u + fx * r, v), k1) for r in radii])
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
        out = np.empty(10)
        write_ray(0.4, 0.3, cam, guess, out)
        results.append(out)
    np.testing.assert_allclose(results, [results[0]] * 4, atol=1e-12)


K1 = -0.15


def bend(x, K):
    rays = (x - K[:2, 2]) / K[[0, 1], [0, 1]]
    return x + K1 * np.sum(rays**2, axis=1, keepdims=True) * (x - K[:2, 2])


def test_without_its_lens_a_camera_has_the_true_fundamental_matrices():
    tracks = make_tracks(TrackOptions(cameras=4, sigma_px=0.0), seed=2)
    K, views = tracks.K[0], list(tracks.pairs.values())
    bent = [np.hstack([bend(view.x1, K), bend(view.x2, K)]) for view in views]
    pairs = CameraPairs(tracks.F, np.ones(len(views)), tracks.size, tuple(tracks.pairs), tuple(bent))
    camera = Calibration(K, *tracks.size, "zero-curves", True, distortion=(K1,))
    found = undistort_pairs(pairs, camera)
    for F, view, straight in zip(found.Fs, views, found.inliers, strict=True):
        np.testing.assert_allclose(straight, np.hstack([view.exact_x1, view.exact_x2]), atol=1e-6)
        assert sampson_distance(F, view.exact_x1, view.exact_x2).max() < 1e-4
    assert np.max(np.abs(bent[0] - found.inliers[0])) > 3


def test_without_a_lens_or_matches_nothing_changes():
    pairs = CameraPairs.from_Fs(np.eye(3)[None], (640, 480))
    bent = Calibration(np.eye(3), 640, 480, "zero-curves", True, distortion=(K1,))
    assert undistort_pairs(pairs, bent) is pairs
