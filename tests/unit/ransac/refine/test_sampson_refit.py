"""The refits: a minimum of the stated cost, rank 2, robust, and as exact as the data; and what F is made of."""

import itertools

import numpy as np
import pytest

from sfm_app.fundamental.points import prepare
from sfm_app.fundamental.refits import factorize, fit_algebraic, fit_eight_point, refine_mixture, refine_sampson
from sfm_app.fundamental.scores import squared_distances
from sfm_app.geometry.epipolar import sampson_distance
from sfm_app.synthetic.correspondences import PairOptions, make_pair


def scene(seed, **options):
    pair = make_pair(PairOptions(**options), seed)
    m = prepare(pair.x1, pair.x2, seed)
    good = np.empty(len(pair.x1), dtype=bool)
    good[m.rows] = pair.is_inlier
    return pair, m, good


def moved(points, by, seed):
    return np.asfortranarray(points + by * np.random.default_rng(seed).normal(size=points.shape))


def cost(points, F, scale=np.inf):
    squared = squared_distances(points, np.ascontiguousarray(F).reshape(9))
    return (squared / (1 + squared / scale**2)).sum()


@pytest.mark.parametrize("scale", [np.inf, 0.01])
@pytest.mark.parametrize("seed", range(4))
def test_no_neighbor_of_rank_two_is_better(seed, scale):
    _, m, good = scene(seed, points=200)
    start = fit_eight_point(m.points, good.astype(float))

    F = refine_sampson(m.points, start, scale=scale, most_steps=100, enough=0.0)

    least = cost(m.points, F, scale)
    assert least < cost(m.points, start, scale)
    rng, (U, s, Vt) = np.random.default_rng(seed), np.linalg.svd(F)
    assert s[2] < 1e-12
    for _ in range(50):
        turns = [np.linalg.qr(np.eye(3) + 1e-4 * rng.normal(size=(3, 3)))[0] for _ in range(2)]
        near = U @ turns[0] @ np.diag([s[0], s[1] * (1 + 1e-4 * rng.normal()), 0]) @ turns[1] @ Vt
        assert cost(m.points, near, scale) > least * (1 - 1e-9)


@pytest.mark.parametrize("seed", range(5))
def test_exact_matches_give_the_exact_matrix(seed):
    pair = make_pair(PairOptions(points=60, sigma_px=0), seed)
    m = prepare(pair.x1, pair.x2, seed)
    rough = fit_eight_point(moved(m.points, 0.003, seed), np.ones(60))
    assert np.sqrt(squared_distances(m.points, rough.reshape(9))).max() * m.unit_px > 0.1

    F = m.to_pixels(refine_sampson(m.points, rough, most_steps=100))

    assert sampson_distance(F, pair.x1, pair.x2).max() < 1e-4


def test_residuals_are_the_injected_noise():
    pair, m, _ = scene(0, points=1000, sigma_px=0.5)
    F = m.to_pixels(refine_sampson(m.points, fit_eight_point(m.points, np.ones(1000))))
    rms = np.sqrt(np.mean(sampson_distance(F, pair.x1, pair.x2) ** 2))
    assert rms == pytest.approx(0.5 * np.sqrt(1 - 7 / 1000), rel=0.06)


@pytest.mark.parametrize("seed", range(4))
def test_it_beats_the_eight_point_algorithm_on_the_truth(seed):
    worse = 0
    for k in range(5):
        pair, m, _ = scene(10 * seed + k, points=100)
        linear = fit_eight_point(m.points, np.ones(100))
        refined = refine_sampson(m.points, linear)
        errors = [np.median(sampson_distance(m.to_pixels(F), pair.exact_x1, pair.exact_x2)) for F in (linear, refined)]
        worse += errors[1] > errors[0]
    assert worse <= 2


def test_outliers_far_beyond_the_scale_do_not_pull():
    pair, m, good = scene(1, points=400, outliers=0.4)
    start = fit_eight_point(m.points, good.astype(float))
    F = refine_sampson(m.points, start, scale=1 / m.unit_px)
    error = sampson_distance(m.to_pixels(F), pair.exact_x1, pair.exact_x2)[pair.is_inlier]
    assert 0 < np.sqrt(np.mean(error**2)) < 0.5


def test_eight_point_agrees_with_the_reference():
    from sfm_app.geometry.epipolar import eight_point

    pair, m, _ = scene(2, points=50, sigma_px=0)
    F = m.to_pixels(fit_eight_point(m.points, np.ones(50)))
    np.testing.assert_allclose(F, eight_point(pair.x1, pair.x2), atol=1e-6)


def test_steps_are_limited():
    _, m, _ = scene(3, points=100)
    start = fit_eight_point(m.points, np.ones(100))
    costs = [cost(m.points, refine_sampson(m.points, start, most_steps=n)) for n in range(4)]
    assert costs[0] == pytest.approx(cost(m.points, start), rel=1e-9)
    assert costs[0] > costs[1] >= costs[2] >= costs[3]


@pytest.mark.parametrize("scale_px", [0.3, 1.0, 10.0, np.inf])
@pytest.mark.parametrize("seed", range(3))
def test_the_robust_cost_falls_with_every_step(seed, scale_px):
    _, m, good = scene(seed, points=300, outliers=0.3)
    start, scale = fit_eight_point(m.points, np.maximum(good, 0.02)), scale_px / m.unit_px
    costs = [
        cost(m.points, refine_sampson(m.points, start, scale=scale, most_steps=n, enough=0.0), scale) for n in range(9)
    ]
    assert costs[0] == pytest.approx(cost(m.points, start, scale), rel=1e-9)
    # matches that weigh less than a thousandth are left out of a step
    assert all(after <= before * (1 + 1e-4) for before, after in itertools.pairwise(costs))
    assert 0.5 * costs[0] < costs[8] < 0.99 * costs[0]


def test_a_small_decrease_ends_the_search():
    _, m, _ = scene(4, points=100)
    start = fit_eight_point(m.points, np.ones(100))
    soon, one, late = (
        refine_sampson(m.points, start, enough=enough, most_steps=steps)
        for enough, steps in ((1.0, 9), (0.0, 1), (0.0, 9))
    )
    np.testing.assert_array_equal(soon, one)
    assert cost(m.points, late) < cost(m.points, soon)


@pytest.mark.parametrize("sigma_px", [0.3, 1.0])
def test_the_mixture_is_nearly_as_good_as_knowing_the_inliers(sigma_px):
    errors = []
    for seed in range(12):
        pair, m, good = scene(seed, points=400, outliers=0.4, sigma_px=sigma_px, width=1024, height=768, focal_px=900.0)
        start = fit_eight_point(m.points, good.astype(float))
        told = refine_sampson(np.asfortranarray(m.points[good]), start)
        found = refine_mixture(m.points, start, threshold=1.5 / m.unit_px, reach=3.0, most_steps=20)
        errors.append([np.mean(sampson_distance(m.to_pixels(F), pair.exact_x1, pair.exact_x2)) for F in (told, found)])
    told, found = np.sqrt(np.mean(np.square(errors), axis=0))
    assert 0.95 < found / told < 1.15
    assert 0.05 * sigma_px < told < 0.2 * sigma_px


def test_the_mixture_measures_the_noise():
    """With the threshold ten times too large, matches off by five sigma hardly pull."""
    pair, m, _ = scene(2, points=600, sigma_px=0.1)
    points = m.points.copy(order="F")
    points[:60, 3] += 1.2 / m.unit_px
    start = fit_eight_point(points, np.ones(600))
    threshold = 1.0 / m.unit_px
    found = refine_mixture(points, start, threshold=threshold, reach=3.0, most_steps=30), refine_sampson(points, start)
    errors = [np.median(sampson_distance(m.to_pixels(F), pair.exact_x1, pair.exact_x2)) for F in found]
    assert errors[0] < 0.03
    assert errors[1] > 2 * errors[0]


def test_perfect_matches_stay_perfect():
    pair, m, good = scene(3, points=200, sigma_px=0.0, outliers=0.3)
    start = fit_eight_point(moved(m.points, 0.001, 3), good.astype(float))
    F = m.to_pixels(refine_mixture(m.points, start, threshold=1.5 / m.unit_px, reach=3.0, most_steps=30))
    assert sampson_distance(start, m.points[:, :2], m.points[:, 2:])[good].max() * m.unit_px > 0.01
    assert sampson_distance(F, pair.x1, pair.x2)[pair.is_inlier].max() < 1e-3


@pytest.mark.parametrize("count", [2, 6, 7, 8])
@pytest.mark.parametrize("threshold", [1e-9, 0.1, 10.0])
def test_few_matches_leave_a_matrix_of_rank_two(count, threshold):
    rng = np.random.default_rng(count)
    points, start = np.asfortranarray(rng.normal(size=(count, 4))), rng.normal(size=(3, 3))
    for F in (
        refine_mixture(points, start, threshold=threshold, reach=3.0, most_steps=12),
        refine_sampson(points, start, scale=threshold),
    ):
        assert np.isfinite(F).all()
        singular = np.linalg.svd(F, compute_uv=False)
        assert singular[0] == pytest.approx(1, abs=1e-9) or singular[1] > 1e-6
        assert singular[2] < 1e-12


def test_the_algebraic_fit_is_the_smallest_singular_vector():
    _, m, _ = scene(5, points=90)
    weights = np.random.default_rng(5).uniform(size=90)
    h1, h2 = (np.column_stack([m.points[:, k : k + 2], np.ones(90)]) for k in (0, 2))
    A = (h2[:, :, None] * h1[:, None, :]).reshape(-1, 9) * np.sqrt(weights)[:, None]
    expected = np.linalg.svd(A)[2][8]
    found = fit_algebraic(m.points, weights).reshape(9)
    np.testing.assert_allclose(found * np.sign(found @ expected), expected, atol=1e-9)


@pytest.mark.parametrize("rank", [1, 2, 3])
@pytest.mark.parametrize("seed", range(20))
def test_factors_are_those_of_the_nearest_matrix_of_rank_two(rank, seed):
    rng = np.random.default_rng([rank, seed])
    F = rng.normal(size=(3, rank)) @ rng.normal(size=(rank, 3)) * 10.0 ** rng.integers(-5, 5)

    U, s, V = factorize(F)

    for R in (U, V):
        np.testing.assert_allclose(R.T @ R, np.eye(3), atol=1e-9)
        assert np.linalg.det(R) == pytest.approx(1)
    singular = np.linalg.svd(F)
    expected = singular.U[:, :2] * singular.S[:2] @ singular.Vh[:2] / singular.S[0]
    assert s == pytest.approx(singular.S[1] / singular.S[0], abs=1e-7)
    np.testing.assert_allclose(U @ np.diag([1, s, 0]) @ V.T, expected, atol=1e-7 if rank == 3 else 1e-9)


def test_factors_of_equal_singular_values():
    F = np.array([[0, -1.0, 0], [1, 0, 0], [0, 0, 0]])
    U, s, V = factorize(F)
    assert s == pytest.approx(1)
    np.testing.assert_allclose(U @ np.diag([1, s, 0]) @ V.T, F, atol=1e-12)
