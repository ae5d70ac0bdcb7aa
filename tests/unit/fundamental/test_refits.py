"""Refits: minima of the stated cost, of rank 2, as exact as the data."""

import itertools

import numpy as np
import pytest

from sfm_app.errors import NumericalError
from sfm_app.fundamental import ESTIMATORS
from sfm_app.fundamental.points import prepare
from sfm_app.fundamental.refits import (
    REFITS,
    choose_refit,
    factorize,
    fit_algebraic,
    fit_eight_point,
    refine_mixture,
    refine_reprojection,
    refine_sampson,
)
from sfm_app.fundamental.scores import squared_distances
from sfm_app.geometry.epipolar import (
    canonical_cameras,
    eight_point,
    fundamental_from_pose,
    nearest_exact_matches,
    nearest_rank_two,
    reprojection_distance,
    sampson_distance,
    to_homogeneous,
)
from sfm_app.settings import EpipolarSettings
from sfm_app.synthetic.correspondences import PairOptions, make_pair
from sfm_app.types import EpipolarFit, Rejected


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


def cost_of(refine):
    return cost if refine is refine_sampson else gold_cost


@pytest.mark.parametrize("refine", [refine_sampson, refine_reprojection])
@pytest.mark.parametrize("scale", [np.inf, 0.01])
@pytest.mark.parametrize("seed", range(4))
def test_no_neighbor_of_rank_two_is_better(refine, seed, scale):
    _, m, _ = scene(seed, points=200)
    start, own = fit_eight_point(m.points, np.ones(200)), cost_of(refine)
    tolerance = {"tolerance": 0.0} if refine is refine_sampson else {}

    F = refine(m.points, start, scale=scale, most_steps=100, **tolerance)

    least = own(m.points, F, scale)
    assert least < own(m.points, start, scale)
    singular = np.linalg.svd(F, compute_uv=False)
    assert singular[2] < 1e-12
    assert (singular[0] if refine is refine_sampson else np.linalg.norm(F)) == pytest.approx(1)
    rng = np.random.default_rng(seed)
    for size in (1e-5, 1e-4, 1e-3):
        for _ in range(30):
            near = nearest_rank_two(F + size * rng.normal(size=(3, 3)))
            assert own(m.points, near, scale) > least * (1 - 1e-9)


@pytest.mark.parametrize(("refine", "worst_px"), [(refine_sampson, 1e-4), (refine_reprojection, 1e-6)])
@pytest.mark.parametrize("seed", range(5))
def test_exact_matches_give_the_exact_matrix(refine, worst_px, seed):
    pair, m, _ = scene(seed, points=60, sigma_px=0)
    rough = fit_eight_point(moved(m.points, 0.003, seed), np.ones(60))
    assert sampson_distance(m.to_pixels(rough), pair.x1, pair.x2).max() > 0.1
    F = m.to_pixels(refine(m.points, rough, most_steps=100))
    assert sampson_distance(F, pair.x1, pair.x2).max() < worst_px


@pytest.mark.parametrize(
    ("refine", "distance"), [(refine_sampson, sampson_distance), (refine_reprojection, reprojection_distance)]
)
def test_residuals_are_the_injected_noise(refine, distance):
    pair, m, _ = scene(0, points=1000, sigma_px=0.5)
    F = m.to_pixels(refine(m.points, fit_eight_point(m.points, np.ones(1000))))
    rms = np.sqrt(np.mean(distance(F, pair.x1, pair.x2) ** 2))
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
    pair, m, _ = scene(2, points=50, sigma_px=0)
    F = m.to_pixels(fit_eight_point(m.points, np.ones(50)))
    np.testing.assert_allclose(F, eight_point(pair.x1, pair.x2), atol=1e-6)


@pytest.mark.parametrize("refine", [refine_sampson, refine_reprojection])
def test_steps_are_limited(refine):
    _, m, _ = scene(3, points=100, sigma_px=3)
    start, own = fit_eight_point(m.points, np.ones(100)), cost_of(refine)
    costs = [own(m.points, refine(m.points, start, most_steps=n)) for n in range(4)]
    assert costs[0] == pytest.approx(own(m.points, start), rel=1e-9)
    assert costs[0] > costs[1] >= costs[2] >= costs[3]


@pytest.mark.parametrize("scale_px", [0.3, 1.0, 10.0, np.inf])
@pytest.mark.parametrize("seed", range(3))
def test_the_robust_cost_falls_with_every_step(seed, scale_px):
    _, m, good = scene(seed, points=300, outliers=0.3)
    start, scale = fit_eight_point(m.points, np.maximum(good, 0.02)), scale_px / m.unit_px
    costs = [
        cost(m.points, refine_sampson(m.points, start, scale=scale, most_steps=n, tolerance=0.0), scale)
        for n in range(9)
    ]
    assert costs[0] == pytest.approx(cost(m.points, start, scale), rel=1e-9)
    # matches that weigh less than a thousandth are left out of a step
    assert all(after <= before * (1 + 1e-4) for before, after in itertools.pairwise(costs))
    assert 0.5 * costs[0] < costs[8] < 0.99 * costs[0]


def test_a_small_decrease_ends_the_search():
    _, m, _ = scene(4, points=100)
    start = fit_eight_point(m.points, np.ones(100))
    soon, one, late = (
        refine_sampson(m.points, start, tolerance=tolerance, most_steps=steps)
        for tolerance, steps in ((1.0, 9), (0.0, 1), (0.0, 9))
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
@pytest.mark.parametrize("seed", range(6))
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


def gold_scene(seed, **options):
    pair = make_pair(PairOptions(**options), seed)
    m = prepare(pair.x1, pair.x2, seed)
    return pair, m, fit_eight_point(m.points, np.ones(len(m.points)))


def gold_cost(points, F, scale=np.inf):
    squared = reprojection_distance(F, points[:, :2], points[:, 2:]) ** 2
    return squared.sum() if scale == np.inf else (scale**2 * np.log1p(squared / scale**2)).sum()


def test_it_is_as_near_to_the_truth_as_the_refit_on_its_first_order():
    errors = []
    for seed in range(12):
        pair, m, start = gold_scene(seed, points=100, sigma_px=2)
        both = refine_sampson(m.points, start), refine_reprojection(m.points, start)
        assert gold_cost(m.points, both[1]) < gold_cost(m.points, both[0])
        errors.append([np.median(sampson_distance(m.to_pixels(F), pair.exact_x1, pair.exact_x2)) for F in both])
    sampson, reprojection = np.median(errors, axis=0)
    assert reprojection == pytest.approx(sampson, rel=0.03)
    assert reprojection < 1


def test_it_is_the_minimum_over_cameras_and_points():
    """One Gauss-Newton step of plain bundle adjustment, all cameras and points at once, has nowhere to go."""
    _, m, start = gold_scene(1, points=30, sigma_px=3)
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
        assert bundle_cost(m.points, state) == pytest.approx(gold_cost(m.points, model), rel=1e-6)
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

    best = gold_cost(m.points, refine_reprojection(m.points, refine_sampson(m.points, start), most_steps=100))
    assert gold_cost(m.points, F) == pytest.approx(best, rel=1e-3)
    assert gold_cost(m.points, F) * m.unit_px**2 < (reprojection_distance(truth, *noisy) ** 2).sum()


def test_points_at_infinity_are_points():
    pair, _, _ = gold_scene(5, points=100, sigma_px=0)
    rng = np.random.default_rng(5)
    far = to_homogeneous(pair.exact_x1[:50]) @ (pair.K2 @ pair.R @ np.linalg.inv(pair.K1)).T
    x1, x2 = pair.exact_x1, np.vstack([far[:, :2] / far[:, 2:], pair.exact_x2[50:]])
    m = prepare(x1 + rng.normal(size=x1.shape), x2 + rng.normal(size=x2.shape), 0)
    F = m.to_pixels(refine_reprojection(m.points, fit_eight_point(m.points, np.ones(100))))
    assert 0.01 < np.sqrt(np.mean(sampson_distance(F, x1, x2) ** 2)) < 1


def test_the_cauchy_scale_holds_outliers_off():
    pair, m, _ = gold_scene(1, points=400, sigma_px=0.5, outliers=0.05)
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
    assert gold_cost(points, F) <= gold_cost(points, nearest_rank_two(start))


@pytest.mark.parametrize("F", [np.zeros((3, 3)), np.full((3, 3), np.nan)])
def test_no_start_is_refused(F):
    with pytest.raises(NumericalError, match="zero or not finite"):
        refine_reprojection(CLOUD, F)


CHOICES = ["auto", "eight-point", "sampson", "reprojection"]
SCENE = PairOptions(points=300, sigma_px=0.7, outliers=0.3, width=1024, height=768, focal_px=900.0)


def options(refit):
    return EpipolarSettings(max_error_px=2.0, max_trials=2000, refit=refit)


@pytest.mark.parametrize("estimator", ESTIMATORS)
def test_every_choice_works_on_every_estimator_and_differs(estimator):
    pair, before = make_pair(SCENE, 3), None
    for refit in CHOICES:
        found = ESTIMATORS[estimator][0](pair.x1, pair.x2, options(refit), 0)
        assert isinstance(found, EpipolarFit), found
        assert np.linalg.svd(found.F, compute_uv=False)[2] < 1e-12
        assert 0.5 < np.sqrt(np.mean(sampson_distance(found.F, pair.x1, pair.x2)[pair.is_inlier] ** 2)) < 0.9
        assert 0 < np.median(sampson_distance(found.F, pair.exact_x1, pair.exact_x2)) < 0.4
        assert before is None or np.abs(found.F - before).max() > 0
        before = found.F


@pytest.mark.parametrize("seed", range(5))
def test_each_is_best_at_its_own_distance_on_the_same_inliers(seed):
    pair = make_pair(PairOptions(points=200, sigma_px=2.0, outliers=0.2), seed)
    m = prepare(pair.x1, pair.x2, seed)
    good = np.empty(200)
    good[m.rows] = pair.is_inlier
    threshold, start = 6.0 / m.unit_px, fit_eight_point(m.points, good)
    inliers = m.points[sampson_distance(start, m.points[:, :2], m.points[:, 2:]) <= threshold]
    assert len(inliers) > 120
    fits = {name: refit(m.points, start, threshold) for name, refit in REFITS.items()}
    views = inliers[:, :2], inliers[:, 2:]
    for loss, best in ((sampson_distance, "sampson"), (reprojection_distance, "reprojection")):
        costs = {name: (loss(F, *views) ** 2).sum() for name, F in fits.items()}
        assert min(costs, key=costs.__getitem__) == best, costs


@pytest.mark.parametrize("name", REFITS)
def test_too_few_inliers_leave_the_model_alone(name):
    rng = np.random.default_rng(0)
    points, F = np.asfortranarray(rng.normal(size=(30, 4))), rng.normal(size=(3, 3))
    np.testing.assert_array_equal(REFITS[name](points, F, 1e-9), F)


def test_the_estimators_own_fit_comes_first():
    calls = []

    def own(points, F, threshold):
        calls.append(threshold)
        return F

    points, F = np.asfortranarray(np.random.default_rng(0).normal(size=(30, 4))), np.eye(3)
    assert choose_refit("auto", own) is own
    for name in REFITS:
        choose_refit(name, own)(points, F, 1.0)
    assert calls == [1.0] * 3


@pytest.mark.parametrize("refit", CHOICES)
@pytest.mark.parametrize("estimator", ESTIMATORS)
def test_a_plane_and_a_line_do_not_break_any(estimator, refit):
    rng = np.random.default_rng(1)
    x = rng.uniform(0, 1000, (100, 2))
    line = np.column_stack([np.linspace(0, 1000, 100), np.linspace(0, 700, 100)])
    for x1, x2 in ((x, 0.8 * x + 40), (line, line[:, ::-1].copy()), (x, x.copy())):
        found = ESTIMATORS[estimator][0](x1, x2, options(refit), 0)
        assert isinstance(found, Rejected) or found.degeneracy
