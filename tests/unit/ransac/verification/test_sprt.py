"""Wald's test: the rates that it promises, the matches that it saves, and the trials that its mistakes cost."""

import math

import numpy as np
import pytest

from sfm_app.fundamental.pretests import FIRST_DELTA, MODEL_COST, MODELS_PER_SAMPLE, SequentialTest, Sprt, design

RUNS, COUNT = 20_000, 600
CASES = [(0.8, 0.05), (0.5, 0.05), (0.5, 0.2), (0.3, 0.02)]


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
    assert a == pytest.approx(MODEL_COST[7] * gain / MODELS_PER_SAMPLE[7] + 1 + log_a)

    def time(a):  # Chum and Matas 2008: samples over 1 - 1/A, each with its models and log A / C matches per model
        return (MODEL_COST[7] + MODELS_PER_SAMPLE[7] * (1 + math.log(a)) / gain) / (1 - 1 / a)

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

    expected = (1_500 + 100 * FIRST_DELTA) / 10_100
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
    wrong = SequentialTest(0.75, FIRST_DELTA, design(0.75, FIRST_DELTA, 7).log_threshold)
    test.learn(first)
    test.expect(share)
    right = design(share, FIRST_DELTA, 7)
    total = math.ceil(test.required_trials(share, 0.9))
    passed = [1 - decisions(t, share, runs=5000, seed=k)[0].mean() for k, t in enumerate((wrong, right))]

    def missed(trials):
        rates = np.repeat(passed, [first, trials - first])
        return 1 - (rng.uniform(size=(runs, trials)) < share**7 * rates).any(axis=1).mean()

    assert missed(total) == pytest.approx(0.1, abs=0.025)
    assert total > math.log(0.1) / math.log(1 - share**7) * 1.02
    # enough drawn already: not one more
    test.learn(10 * total)
    test.expect(share)
    assert test.required_trials(share, 0.9) <= first + 10 * total
