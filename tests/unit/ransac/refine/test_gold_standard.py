"""The Gold Standard refit: a minimum of the summed reprojection error, rank 2, robust, and never at a loss."""

import numpy as np
import pytest

from sfm_app.errors import NumericalError
from sfm_app.fundamental.points import prepare
from sfm_app.fundamental.refits import fit_eight_point, refine_reprojection, refine_sampson
from sfm_app.geometry.epipolar import (
    canonical_cameras,
    fundamental_from_pose,
    nearest_exact_matches,
    nearest_rank_two,
    reprojection_distance,
    sampson_distance,
    to_homogeneous,
)
from sfm_app.synthetic.correspondences import PairOptions, make_pair

CLOUD = np.random.default_rng(3).normal(size=(60, 4))
LINE = np.linspace(-1, 1, 30)
TURNED = CLOUD[:, :2] @ [[1, 0.1], [-0.1, 1]] + 0.1

DEGENERATE = {
    "one plane": np.hstack([CLOUD[:, :2], TURNED]),
    "no motion": np.hstack([CLOUD[:, :2], CLOUD[:, :2]]),
    "lines": np.column_stack([LINE, LINE, LINE, -LINE]),
    "one match, repeated": np.tile(CLOUD[:1], (20, 1)),
    "all at the origin": np.zeros((10, 4)),
    "seven": CLOUD[:7],
    "three": CLOUD[:3],
    "none": CLOUD[:0],
}


def scene(seed, **options):
    pair = make_pair(PairOptions(**options), seed)
    m = prepare(pair.x1, pair.x2, seed)
    return pair, m, fit_eight_point(m.points, np.ones(len(m.points)))


def cost(points, F, scale=np.inf):
    squared = reprojection_distance(F, points[:, :2], points[:, 2:]) ** 2
    return squared.sum() if scale == np.inf else (scale**2 * np.log1p(squared / scale**2)).sum()


@pytest.mark.parametrize("scale", [np.inf, 0.01])
@pytest.mark.parametrize("seed", range(4))
def test_no_neighbor_of_rank_two_is_better(seed, scale):
    _, m, start = scene(seed, points=100, sigma_px=3)

    F = refine_reprojection(m.points, start, scale=scale, most_steps=100)

    least = cost(m.points, F, scale)
    assert least < cost(m.points, start, scale)
    rng, singular = np.random.default_rng(seed), np.linalg.svd(F, compute_uv=False)
    assert singular[2] < 1e-15
    assert np.linalg.norm(F) == pytest.approx(1)
    for size in (1e-5, 1e-4, 1e-3):
        for _ in range(30):
            near = nearest_rank_two(F + size * rng.normal(size=(3, 3)))
            assert cost(m.points, near, scale) > least * (1 - 1e-9)


@pytest.mark.parametrize("seed", range(5))
def test_exact_matches_give_the_exact_matrix(seed):
    pair, m, _ = scene(seed, points=60, sigma_px=0)
    rough = fit_eight_point(
        np.asfortranarray(m.points + 0.003 * np.random.default_rng(seed).normal(size=(60, 4))), np.ones(60)
    )
    assert sampson_distance(m.to_pixels(rough), pair.x1, pair.x2).max() > 0.1

    F = m.to_pixels(refine_reprojection(m.points, rough, most_steps=100))

    assert sampson_distance(F, pair.x1, pair.x2).max() < 1e-6


def test_residuals_are_the_injected_noise():
    pair, m, start = scene(0, points=1000, sigma_px=0.5)
    F = m.to_pixels(refine_reprojection(m.points, start))
    rms = np.sqrt(np.mean(reprojection_distance(F, pair.x1, pair.x2) ** 2))
    assert rms == pytest.approx(0.5 * np.sqrt(1 - 7 / 1000), rel=0.06)


def test_it_is_as_near_to_the_truth_as_the_refit_on_its_first_order():
    errors = []
    for seed in range(12):
        pair, m, start = scene(seed, points=100, sigma_px=2)
        both = refine_sampson(m.points, start), refine_reprojection(m.points, start)
        assert cost(m.points, both[1]) < cost(m.points, both[0])
        errors.append([np.median(sampson_distance(m.to_pixels(F), pair.exact_x1, pair.exact_x2)) for F in both])
    sampson, reprojection = np.median(errors, axis=0)
    assert reprojection == pytest.approx(sampson, rel=0.03)
    assert reprojection < 1


def test_it_is_the_minimum_over_cameras_and_points():
    """One Gauss-Newton step of plain bundle adjustment, all cameras and points at once, has nowhere to go."""
    _, m, start = scene(1, points=30, sigma_px=3)
    F = refine_reprojection(m.points, start, most_steps=100)
    gradients = []
    for model in (start, F):
        P2 = canonical_cameras(model)[1]
        exact1, exact2 = (to_homogeneous(x) for x in nearest_exact_matches(model, m.points[:, :2], m.points[:, 2:]))
        across = np.cross(exact2, P2[:, 3])
        w = -(np.cross(exact2, exact1 @ P2[:, :3].T) * across).sum(axis=1) / (across**2).sum(axis=1)
        state = np.concatenate([P2.ravel(), np.column_stack([exact1[:, :2], w]).ravel()])
        gradient = [
            (bundle_cost(m.points, state + h) - bundle_cost(m.points, state - h)) / 2e-6 for h in 1e-6 * np.eye(102)
        ]
        assert bundle_cost(m.points, state) == pytest.approx(cost(m.points, model), rel=1e-6)
        gradients.append(np.abs(gradient).max())
    assert gradients[1] < 1e-4 * gradients[0]


def bundle_cost(points, state):
    """12 entries of P2, then (u, v, w) of every point (u, v, 1, w)."""
    u, v, w = state[12:].reshape(-1, 3).T
    image = np.column_stack([u, v, np.ones_like(u), w]) @ state[:12].reshape(3, 4).T
    return ((np.column_stack([u, v, image[:, :2] / image[:, 2:]]) - points) ** 2).sum()


@pytest.mark.parametrize("seed", range(3))
def test_matches_near_the_epipole_do_not_hold_it_back(seed):
    # straight ahead, a quarter of the points close to the way: their depth is undetermined
    rng = np.random.default_rng(seed)
    K = np.diag([700.0, 700.0, 1.0])
    X = np.column_stack([rng.uniform(-2, 2, (200, 2)), rng.uniform(4, 9, 200)])
    X[:50, :2] *= 1e-3
    x1, x2 = ((X + shift) @ K.T for shift in ([0, 0, 0], [0, 0, -1]))
    noisy = [x[:, :2] / x[:, 2:] + rng.normal(size=(200, 2)) for x in (x1, x2)]
    m = prepare(*noisy, seed)
    truth = fundamental_from_pose(K, K, np.eye(3), [0, 0, -1])
    start = fit_eight_point(m.points, np.ones(200))

    F = refine_reprojection(m.points, start, most_steps=100)

    best = cost(m.points, refine_reprojection(m.points, refine_sampson(m.points, start), most_steps=100))
    assert cost(m.points, F) == pytest.approx(best, rel=1e-3)
    assert cost(m.points, F) * m.unit_px**2 < (reprojection_distance(truth, *noisy) ** 2).sum()


def test_points_at_infinity_are_points():
    pair, _, _ = scene(5, points=100, sigma_px=0)
    rng = np.random.default_rng(5)
    far = to_homogeneous(pair.exact_x1[:50]) @ (pair.K2 @ pair.R @ np.linalg.inv(pair.K1)).T
    x1, x2 = pair.exact_x1, np.vstack([far[:, :2] / far[:, 2:], pair.exact_x2[50:]])
    m = prepare(x1 + rng.normal(size=x1.shape), x2 + rng.normal(size=x2.shape), 0)

    F = m.to_pixels(refine_reprojection(m.points, fit_eight_point(m.points, np.ones(100))))

    assert 0.01 < np.sqrt(np.mean(sampson_distance(F, x1, x2) ** 2)) < 1


def test_the_cauchy_scale_holds_outliers_off():
    pair, m, _ = scene(1, points=400, sigma_px=0.5, outliers=0.05)
    start = refine_sampson(m.points, fit_eight_point(m.points, np.ones(400)), scale=2 / m.unit_px)
    blind, robust = (refine_reprojection(m.points, start, scale=s, most_steps=50) for s in (np.inf, 1 / m.unit_px))
    errors = [np.median(sampson_distance(m.to_pixels(F), pair.exact_x1, pair.exact_x2)) for F in (blind, robust)]
    assert errors[1] < 0.2
    assert errors[0] > 5 * errors[1]


@pytest.mark.parametrize("case", DEGENERATE)
@pytest.mark.parametrize("seed", range(3))
def test_matches_that_do_not_determine_the_matrix_still_get_one(case, seed):
    points = DEGENERATE[case]
    start = np.random.default_rng(seed).normal(size=(3, 3))
    F = refine_reprojection(points, start)
    assert np.linalg.svd(F, compute_uv=False)[2] < 1e-15
    assert cost(points, F) <= cost(points, nearest_rank_two(start))


def test_steps_are_limited():
    _, m, start = scene(3, points=100, sigma_px=3)
    costs = [cost(m.points, refine_reprojection(m.points, start, most_steps=n)) for n in range(4)]
    assert costs[0] == pytest.approx(cost(m.points, start), rel=1e-9)
    assert costs[0] > costs[1] >= costs[2] >= costs[3]


def test_ten_thousand_matches_and_the_same_bytes_twice():
    _, m, start = scene(2, points=10_000)
    F = refine_reprojection(m.points, start)
    assert F.tobytes() == refine_reprojection(m.points, start).tobytes()
    assert cost(m.points, F) < cost(m.points, start)


@pytest.mark.parametrize("F", [np.zeros((3, 3)), np.full((3, 3), np.nan)])
def test_no_start_is_refused(F):
    with pytest.raises(NumericalError, match="zero or not finite"):
        refine_reprojection(CLOUD, F)
