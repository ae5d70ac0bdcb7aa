"""The non-linear refit: a minimum of the stated cost, rank 2, robust, and as exact as the data."""

import numpy as np
import pytest

from sfm_app.geometry.distances import sampson_distance
from sfm_app.ransac.points import prepare
from sfm_app.ransac.refit import fit_eight_point, refine_sampson
from sfm_app.ransac.scoring import squared_distances
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
def test_no_neighbour_of_rank_two_is_better(seed, scale):
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
