"""Pre-tests: error rates, savings, and the additional samples."""

import math

import numpy as np
import pytest

from sfm_app.fundamental.pretests import (
    BLOCK,
    SPRT,
    BailOut,
    FullScoring,
    PreTest,
    RandomizedTdd,
    SequentialTest,
    Sprt,
    bail_out_table,
    design,
)
from sfm_app.fundamental.samples import required_trials
from sfm_app.fundamental.scores import msac, penalty
from sfm_app.geometry.epipolar import cross_matrix

SHIFT = cross_matrix([1.0, 0, 0]).reshape(9)


def matches_of(inlier):
    """Matches of a shift along x, those that are no inliers 9 units off, twice over."""
    count = len(inlier)
    points = np.column_stack([np.arange(count), np.zeros(count), np.arange(count) + 5.0, np.where(inlier, 0.0, 9.0)])
    return np.asfortranarray(np.vstack([points, points]))


def passes(pretest: PreTest, inlier) -> np.ndarray:
    """For every match to begin with, whether the model passes."""
    circle, count = matches_of(inlier), len(inlier)
    loss = msac(circle, 1.0, None)
    return np.array([penalty(circle, k, SHIFT, loss, np.inf, pretest) < np.inf for k in range(count)])


@pytest.mark.parametrize("share", [0.2, 0.5, 0.9])
@pytest.mark.parametrize("d", [1, 2])
def test_a_good_model_passes_tdd_with_probability_share_to_the_d(share, d):
    rng, count = np.random.default_rng(d), 4000
    inlier = rng.permutation(count) < share * count
    test = type("Tdd", (RandomizedTdd,), {"d": d})(count, 7)
    rate = passes(test.pretest, inlier).mean()
    assert rate == pytest.approx(share) if d == 1 else rate == pytest.approx(share**d, abs=0.02)
    assert test.pretest.random_start
    assert test.pretest.rejected[0] >= (1 - rate) * count
    # 3.19 with that probability: one more match per d that has to be an inlier by luck
    assert test.required_trials(share, 0.99) == pytest.approx(required_trials(share ** (7 + d), 0.99))


def test_tdd_beginning_at_its_own_match_reaches_the_stated_confidence():
    rng, share, runs, count = np.random.default_rng(3), 0.7, 4000, 500
    pretest = RandomizedTdd(count, 7).pretest
    pass_rate = passes(pretest, rng.permutation(count) < share * count).mean()
    trials = math.ceil(RandomizedTdd(count, 7).required_trials(share, 0.9))
    plain = math.ceil(FullScoring(count, 7).required_trials(share, 0.9))

    def missed(trials):
        found = (rng.uniform(size=(runs, trials)) < share**7) & (rng.uniform(size=(runs, trials)) < pass_rate)
        return 1 - found.any(axis=1).mean()

    assert 0.08 < missed(trials) < 0.12
    assert missed(plain) > 0.15


def test_full_verification_has_no_test_and_plain_trials():
    test = FullScoring(100, 8)
    assert len(test.pretest.least_inliers) == 0
    assert test.required_trials(0.5, 0.99) == pytest.approx(required_trials(0.5**8, 0.99))
    test.expect(0.3)
    test.learn(10)
    assert test.required_trials(0.5, 0.99) == pytest.approx(required_trials(0.5**8, 0.99))


def test_bail_out_learns_from_the_best_model():
    test = BailOut(20 * BLOCK, 7)
    assert len(test.pretest.least_inliers) == 0
    test.expect(0.5)
    np.testing.assert_array_equal(test.pretest.least_inliers, bail_out_table(20 * BLOCK, 0.5))
    assert (test.pretest.stride, test.pretest.random_start) == (BLOCK, False)


@pytest.mark.parametrize("share", [0.1, 0.5, 0.9])
def test_bail_out_rarely_drops_an_equal_model_and_mostly_a_bad_one(share):
    rng, count = np.random.default_rng(1), 2000
    table = bail_out_table(count, share)

    def survives(real_share):
        inlier = rng.permutation(count) < round(real_share * count)
        seen = np.cumsum(inlier)[BLOCK - 1 : -1 : BLOCK][: len(table)]
        return (seen >= table).all()

    assert np.mean([survives(share) for _ in range(300)]) > 0.97
    assert np.mean([survives(share / 2) for _ in range(300)]) < 0.1


def test_bail_out_table_of_few_matches_is_empty():
    assert len(bail_out_table(BLOCK, 0.5)) == len(bail_out_table(1, 1.0)) == 0
    assert bail_out_table(4 * BLOCK, 1.0).tolist() == [BLOCK, 2 * BLOCK, 3 * BLOCK]


RUNS, COUNT = 20_000, 600
CASES = [pytest.param(0.8, 0.05, marks=pytest.mark.slow), (0.5, 0.05), (0.5, 0.2), (0.3, 0.02)]


def decisions(test, share, *, runs=RUNS, seed=0):
    """For models of which this share of the matches are inliers: rejected or not, and after how many matches."""
    hits = np.random.default_rng(seed).uniform(size=(runs, COUNT)) < share
    below = np.cumsum(hits, axis=1) < test.least_inliers(COUNT)
    rejected = below.any(axis=1)
    return rejected, np.where(rejected, below.argmax(axis=1) + 1, COUNT)


@pytest.mark.parametrize(("epsilon", "delta"), CASES)
def test_threshold_solves_its_equation_and_is_where_the_time_is_least(epsilon, delta):
    log_a = design(epsilon, delta, 7).log_threshold
    gain = (1 - delta) * math.log((1 - delta) / (1 - epsilon)) + delta * math.log(delta / epsilon)
    a = math.exp(log_a)
    assert a == pytest.approx(SPRT.model_cost * gain / SPRT.models[0] + 1 + log_a)

    def time(a):  # Chum and Matas 2008: samples over 1 - 1/A, each with its models and log A / C matches per model
        return (SPRT.model_cost + SPRT.models[0] * (1 + math.log(a)) / gain) / (1 - 1 / a)

    assert time(a) < min(time(1.3 * a), time(a / 1.3))


@pytest.mark.parametrize(("epsilon", "delta"), CASES)
def test_least_inliers_are_the_likelihood_ratio(epsilon, delta):
    test = design(epsilon, delta, 7)
    hits = np.random.default_rng(1).uniform(size=(200, COUNT)) < (epsilon + delta) / 2
    steps = np.where(hits, math.log(delta / epsilon), math.log((1 - delta) / (1 - epsilon)))
    np.testing.assert_array_equal(
        np.cumsum(steps, axis=1) > test.log_threshold, np.cumsum(hits, axis=1) < test.least_inliers(COUNT)
    )


@pytest.mark.parametrize(("epsilon", "delta"), CASES)
def test_good_models_fall_at_most_once_in_a(epsilon, delta):
    test = design(epsilon, delta, 7)
    a = math.exp(test.log_threshold)
    assert 0.2 / a < decisions(test, epsilon)[0].mean() < 1 / a
    assert test.pass_rate(epsilon) == pytest.approx(1 - 1 / a, rel=1e-6)


@pytest.mark.parametrize("share", [0.42, 0.6])
def test_models_other_than_expected_fall_once_in_a_to_the_h(share):
    test = design(0.5, 0.05, 7)
    rate = 1 - test.pass_rate(share)
    assert 0.2 * rate < decisions(test, share)[0].mean() < rate
    assert (rate < 1 - test.pass_rate(0.5)) == (share > 0.5)


@pytest.mark.parametrize(("epsilon", "delta"), CASES)
def test_bad_models_are_left_after_few_matches(epsilon, delta):
    test = design(epsilon, delta, 7)
    rejected, checked = decisions(test, delta, runs=4000)
    gain = (1 - delta) * math.log((1 - delta) / (1 - epsilon)) + delta * math.log(delta / epsilon)
    # log A / C matches, and what the last step takes beyond the threshold
    assert rejected.all()
    assert 1 <= checked.mean() / (test.log_threshold / gain) < 1.45


@pytest.mark.parametrize(("epsilon", "delta"), [(0.1, 0.1), (0.05, 0.1), (0.0, 0.01)])
def test_models_that_look_alike_are_all_let_through(epsilon, delta):
    test = design(epsilon, delta, 7)
    assert len(test.least_inliers(100)) == 0
    assert test.pass_rate(0.0) == 1.0


def test_perfect_and_hopeless_shares_are_no_trouble():
    test = design(1.0, 0.01, 8)
    assert test.pass_rate(1.0) > 0.99
    assert test.pass_rate(0.0) == 0.0
    assert Sprt(100, 7).required_trials(0.0, 0.99) == math.inf


def test_delta_follows_the_rejected_models_and_the_gate_follows_delta():
    test = Sprt(COUNT, 7)
    test.expect(0.6)
    before = test.pretest
    test.learn(100)
    assert test.pretest is before  # nothing was rejected: nothing learnt

    before.rejected[:] = 10_000, 1_500
    test.learn(100)

    expected = (1_500 + 100 * SPRT.first_delta) / 10_100
    np.testing.assert_array_equal(test.pretest.least_inliers, design(0.6, expected, 7).least_inliers(COUNT))
    assert test.pretest.rejected is before.rejected
    before.rejected[:] = 10_000, 1_510
    kept = test.pretest
    test.learn(100)
    assert test.pretest is kept


def test_trials_reach_the_confidence_though_good_models_fall():
    """Two tests in turn, the first one made for far too many inliers; clean models are checked as the loop does."""
    rng, share, runs, first = np.random.default_rng(5), 0.6, 3000, 25
    test = Sprt(COUNT, 7)
    test.expect(0.75)
    wrong = SequentialTest(0.75, SPRT.first_delta, design(0.75, SPRT.first_delta, 7).log_threshold)
    test.learn(first)
    test.expect(share)
    right = design(share, SPRT.first_delta, 7)
    total = math.ceil(test.required_trials(share, 0.9))
    passed = [1 - decisions(t, share, runs=5000, seed=k)[0].mean() for k, t in enumerate((wrong, right))]

    def missed(trials):
        rates = np.repeat(passed, [first, trials - first])
        return 1 - (rng.uniform(size=(runs, trials)) < share**7 * rates).any(axis=1).mean()

    assert missed(total) == pytest.approx(0.1, abs=0.025)
    assert total > math.log(0.1) / math.log(1 - share**7) * 1.02
    # enough samples already: not one more
    test.learn(10 * total)
    test.expect(share)
    assert test.required_trials(share, 0.9) <= first + 10 * total
