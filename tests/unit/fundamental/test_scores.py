"""Penalties by hand, early exits, and the likelihoods of MLESAC and RES-RANSAC."""

import math
from functools import partial

import numpy as np
import pytest

from sfm_app.fundamental.points import prepare
from sfm_app.fundamental.pretests import BLOCK, NO_PRETEST, make_pretest
from sfm_app.fundamental.scores import (
    SIGMAS,
    geman_mcclure,
    inlier_share,
    lmeds,
    mlesac,
    msac,
    msac_linear,
    outlier_window,
    penalty,
    ransac,
    residual_validity,
    squared_distances,
    squared_sampson_distance,
    validity_from_residuals,
)
from sfm_app.geometry.epipolar import cross_matrix, sampson_distance
from sfm_app.synthetic.correspondences import PairOptions, make_pair

SOFT = partial(geman_mcclure, scale=0.25)
SHIFT = cross_matrix([1.0, 0, 0]).reshape(9)


def matches_off_by(*pixels):
    """Matches of a shift along x whose Sampson distances are the given ones."""
    y = np.asarray(pixels) * np.sqrt(2)
    return np.asfortranarray(np.column_stack([np.arange(len(y)), np.zeros(len(y)), np.arange(len(y)) + 5.0, y]))


def test_distances_agree_with_the_reference():
    rng = np.random.default_rng(0)
    points, F = np.asfortranarray(rng.normal(size=(50, 4))), rng.normal(size=(3, 3))
    squared = squared_distances(points, F.reshape(9))
    np.testing.assert_allclose(np.sqrt(squared), sampson_distance(F, points[:, :2], points[:, 2:]), rtol=1e-9)
    assert squared_sampson_distance(np.zeros(9), 1.0, 2.0, 3.0, 4.0) == np.inf


@pytest.mark.parametrize(
    ("score", "expected"),
    [
        (ransac, 0 + 0 + 1 + 1),
        (msac, 0 + 0.25 + 4 + 4),
        (msac_linear, 0 + 0.5 + 2 + 2),
        (lmeds, 2.5**2),
        (SOFT, 0 + 0.5 + 6.25 / 6.5 + 1e4 / (1e4 + 0.25)),
    ],
)
def test_penalties_by_hand(score, expected):
    points = matches_off_by(0, 0.5, 2.5, 100)
    assert penalty(points, 0, SHIFT, score(points, 2.0, None), np.inf, NO_PRETEST) == pytest.approx(expected)


@pytest.mark.parametrize("score", [ransac, msac, msac_linear, lmeds, SOFT])
def test_a_score_that_cannot_win_is_left(score):
    points = matches_off_by(*np.linspace(0, 4, 1000))
    loss = score(points, 2.0, None)
    full = penalty(points, 0, SHIFT, loss, np.inf, NO_PRETEST)
    assert penalty(points, 0, SHIFT, loss, full * 1.001, NO_PRETEST) == full
    assert penalty(points, 0, SHIFT, loss, full, NO_PRETEST) == np.inf


def test_a_match_at_the_threshold_is_an_inlier():
    on, beyond = matches_off_by(0.0), matches_off_by(2.0)
    at_two = np.sqrt(squared_distances(beyond, SHIFT)[0])
    assert penalty(on, 0, SHIFT, ransac(on, 0.0, None), np.inf, NO_PRETEST) == 0
    assert penalty(beyond, 0, SHIFT, ransac(beyond, at_two * (1 + 1e-9), None), np.inf, NO_PRETEST) == 0
    assert penalty(beyond, 0, SHIFT, ransac(beyond, at_two * (1 - 1e-9), None), np.inf, NO_PRETEST) == 1


def test_the_gate_turns_away_what_lacks_inliers_and_keeps_books():
    points = matches_off_by(*[9.0] * BLOCK, *[0.0] * 10 * BLOCK)
    loss = msac(points, 2.0, None)
    lenient, strict = (make_pretest(np.array([least]), BLOCK, random_start=False) for least in (0, 1))
    assert penalty(points, 0, SHIFT, loss, np.inf, lenient) == 4 * BLOCK
    assert penalty(points, 0, SHIFT, loss, np.inf, strict) == np.inf
    assert lenient.rejected.tolist() == [0, 0]
    assert strict.rejected.tolist() == [BLOCK, 0]


def test_a_gate_asks_after_its_own_stride():
    points = matches_off_by(0, 0, 9, 0, 0, 0)
    loss = msac(points, 2.0, None)
    for least, passes in [
        ([1, 2, 2], True),
        ([1, 2, 3], False),
        ([1, 2, 2, 3, 4, 5], True),
        ([0, 0, 0, 0, 0, 6], False),
    ]:
        turned = penalty(points, 0, SHIFT, loss, np.inf, make_pretest(np.array(least), 1, random_start=False))
        assert (turned < np.inf) == passes


def test_a_soft_penalty_still_counts_inliers_for_the_gate():
    points = matches_off_by(*[1.9, 2.1] * BLOCK)
    for least, passes in ((BLOCK // 2, True), (BLOCK // 2 + 1, False)):
        pretest = make_pretest(np.array([least]), BLOCK, random_start=False)
        assert (penalty(points, 0, SHIFT, SOFT(points, 2.0, None), np.inf, pretest) < np.inf) == passes


def test_a_match_at_infinity_costs_the_most():
    points = matches_off_by(0.0)
    nothing = np.zeros(9)
    for score, worst in ((ransac, 1.0), (msac, 4.0), (msac_linear, 2.0), (SOFT, 1.0)):
        assert penalty(points, 0, nothing, score(points, 2.0, None), np.inf, NO_PRETEST) == worst


@pytest.mark.parametrize("start", [0, 3, 9])
def test_a_random_start_counts_every_match_once(start):
    points = matches_off_by(*np.linspace(0, 3, 10))
    circle = np.asfortranarray(np.vstack([points, points]))
    loss = msac(points, 2.0, None)
    everywhere = make_pretest(np.zeros(1, dtype=np.int64), 1, random_start=True)
    assert penalty(circle, start, SHIFT, loss, np.inf, everywhere) == pytest.approx(
        penalty(points, 0, SHIFT, loss, np.inf, NO_PRETEST)
    )


UNIT_SHIFT = cross_matrix([1.0, 0, 0]).reshape(9) / np.sqrt(2)
SIGMA = 0.5


def distances(gamma, count=20_000, width=100.0):
    """Signed distances, Gaussian for the share gamma and uniform for the others."""
    rng = np.random.default_rng(0)
    inlier = rng.uniform(size=count) < gamma
    return np.where(inlier, rng.normal(scale=SIGMA, size=count), rng.uniform(-width / 2, width / 2, count))


@pytest.mark.parametrize("gamma", [0.05, 0.3, 0.6, 0.95])
def test_expectation_maximization_recovers_the_share(gamma):
    assert inlier_share(distances(gamma) ** 2, SIGMA, 100.0) == pytest.approx(gamma, abs=0.012)


def test_shares_stay_possible():
    assert inlier_share(np.zeros(50), 1.0, 100.0) == 1 - 1 / 50
    assert inlier_share(np.full(50, 1e6), 1.0, 100.0) == 1 / 50
    assert inlier_share(np.array([np.inf, 0.0, 0.0]), 1.0, 100.0) == pytest.approx(2 / 3, abs=0.02)


@pytest.mark.parametrize("best", [None, UNIT_SHIFT])
def test_penalty_is_the_log_likelihood_less_its_peak(best):
    rng = np.random.default_rng(2)
    y = np.concatenate([rng.normal(scale=SIGMA, size=200), rng.uniform(-50, 50, 300)])
    points = np.asfortranarray(rng.uniform(0, 100, (500, 4)))
    points[:, 3] = points[:, 1] + y * np.sqrt(2)
    r, w = np.sqrt(squared_distances(points, UNIT_SHIFT)), outlier_window(points)
    gamma = 0.5 if best is None else inlier_share(r**2, SIGMA, w)

    def log_p(r):
        inlier = np.exp(-(r**2) / (2 * SIGMA**2)) / (SIGMA * math.sqrt(2 * math.pi))
        return np.log(gamma * inlier + (1 - gamma) / w)

    found = penalty(points, 0, UNIT_SHIFT, mlesac(points, SIGMAS * SIGMA, best), np.inf, NO_PRETEST)

    assert found == pytest.approx(float((log_p(np.zeros(500)) - log_p(r)).sum()), rel=1e-9)
    assert best is None or 0.35 < gamma < 0.45


def test_window_is_the_diagonal_whatever_the_origin():
    points = np.array([[0, 0, 10, 10], [3, 4, 16, 18.0], [1, 1, 11, 11]])
    assert outlier_window(points) == pytest.approx((5 + 10) / 2)
    assert outlier_window(points - 100) == pytest.approx(7.5)
    assert outlier_window(np.zeros((3, 4))) > 0


def test_a_small_example():
    # median 100: bins of 1, the last one from 99 on. Histogram 1, 2 and 4, Gaussian of the rms of all errors
    residuals = np.array([0.5, 1.5, 1.8, 100.0, 200.0, 300.0, 1e3])
    last = 4 * math.exp(-(99.5**2) / (2 * np.mean(residuals**2)))
    first, second = (n * math.exp(-(q**2) / (2 * np.mean(residuals**2))) for n, q in ((1, 0.5), (2, 1.5)))
    total = first + second + last
    expected = [1 - first / total, *[1 - (first + second) / total] * 2, 0, 0, 0, 0]
    np.testing.assert_allclose(validity_from_residuals(residuals), expected, rtol=1e-12)
    assert 0.84 < expected[0] < 0.86


def test_units_do_not_matter_and_order_is_kept():
    residuals = np.abs(np.random.default_rng(0).normal(size=501))
    valid = validity_from_residuals(residuals)
    np.testing.assert_allclose(
        validity_from_residuals(1e-3 * residuals), valid, atol=0.01
    )  # a match may change its bin
    assert (np.diff(valid[np.argsort(residuals)]) <= 0).all()
    assert (valid == 0).sum() == pytest.approx(250, abs=5)


@pytest.mark.parametrize(
    ("residuals", "expected"),
    [
        ([0, 0, 0, 1], [1, 1, 1, 0]),
        ([2, 2, 2], [1, 1, 1]),
        ([1, 1, np.inf], [1, 1, 1]),
        ([1, np.inf, np.inf], [1, 0, 0]),
        ([1, 9, np.inf], None),
    ],
)
def test_residuals_that_tell_little_still_give_priors(residuals, expected):
    valid = validity_from_residuals(np.array(residuals, dtype=float))
    assert valid.max() > 0
    assert expected is None or valid.tolist() == expected


def test_the_true_model_puts_the_priors_on_inliers():
    pair = make_pair(PairOptions(points=400, outliers=0.4), 0)
    m = prepare(pair.x1, pair.x2, 0)
    F = np.diag([m.unit_px, m.unit_px, 1])
    shift1, shift2 = np.eye(3), np.eye(3)
    shift1[:2, 2], shift2[:2, 2] = m.center[:2], m.center[2:]
    f = (F.T @ shift2.T @ pair.F @ shift1 @ F).reshape(9)
    valid = residual_validity(m.points, f, 1.0)[m.rows]
    assert valid[pair.is_inlier].mean() > 5 * valid[~pair.is_inlier].mean()
    assert (valid > 0).mean() == pytest.approx(0.5, abs=0.02)
