"""Tests of hypotheses: what they let through, and the trials that they cost."""

import math

import numpy as np
import pytest

from sfm_app.fundamental.pretests import BLOCK, BailOut, FullVerification, PreTest, RandomizedTdd, bail_out_table
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
    plain = math.ceil(FullVerification(count, 7).required_trials(share, 0.9))

    def missed(trials):
        found = (rng.uniform(size=(runs, trials)) < share**7) & (rng.uniform(size=(runs, trials)) < pass_rate)
        return 1 - found.any(axis=1).mean()

    assert 0.08 < missed(trials) < 0.12
    assert missed(plain) > 0.15


def test_full_verification_has_no_test_and_plain_trials():
    test = FullVerification(100, 8)
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
    assert len(bail_out_table(BLOCK, 0.5)) == 0
    assert bail_out_table(1, 1.0).tolist() == []
    assert bail_out_table(4 * BLOCK, 1.0).tolist() == [BLOCK, 2 * BLOCK, 3 * BLOCK]
