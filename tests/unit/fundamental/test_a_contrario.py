"""Support by chance is no evidence, and 20 true inliers are."""

import math

import numpy as np
import pytest
from scipy.stats import binom

from sfm_app.fundamental import ESTIMATORS
from sfm_app.fundamental.a_contrario import (
    accidental_share,
    false_alarms,
    log_binomial_tail,
    squared_mismatch_distances,
)
from sfm_app.fundamental.points import prepare
from sfm_app.fundamental.scores import squared_distances
from sfm_app.geometry.epipolar import cross_matrix, eight_point
from sfm_app.settings import EpipolarSettings
from sfm_app.synthetic.correspondences import PairOptions, make_pair
from sfm_app.types import EpipolarFit, Rejected

OPTIONS = EpipolarSettings(max_trials=3000, min_inliers=8)  # so that only the test of chance stands in the way


@pytest.mark.parametrize(("n", "k", "p"), [(10, 3, 0.2), (200, 20, 0.005), (5000, 100, 0.01), (30, 29, 0.3)])
def test_binomial_tail_is_bounded_from_above_and_closely(n, k, p):
    excess = log_binomial_tail(n, k, p) - binom.logsf(k - 1, n, p)
    # the term at k alone is at least the bound over this (Ash 1965)
    assert 0 <= excess <= 0.5 * math.log(8 * k * (1 - k / n))


def test_binomial_tails_at_the_ends():
    assert log_binomial_tail(30, 30, 0.3) == pytest.approx(30 * math.log(0.3))
    assert log_binomial_tail(30, 9, 0.3) == log_binomial_tail(30, 0, 0.1) == 0.0
    assert log_binomial_tail(10, 11, 0.5) == -math.inf


def test_false_alarms_by_hand():
    # 10 matches, samples of 2: 45 of them, and all 8 others must agree
    assert false_alarms(10, 10, 2, 0.5) == pytest.approx(45 * 0.5**8)
    assert false_alarms(10, 2, 2, 0.5) == 1e300


def test_accidental_share_is_the_area_of_the_band():
    # a shift along x in a square of side 1: |y1 - y2| < w has probability 2 w - w^2
    points = np.asfortranarray(np.random.default_rng(0).uniform(size=(300, 4)))
    wrong = squared_mismatch_distances(points, cross_matrix([1.0, 0, 0]).reshape(9))
    width = 0.1
    assert accidental_share(wrong, width / np.sqrt(2)) == pytest.approx(2 * width - width**2, rel=0.1)
    assert 0 < accidental_share(wrong, 0.0) < accidental_share(wrong, 10.0) < 1


def test_mismatches_never_pair_a_point_with_its_partner():
    pair = make_pair(PairOptions(points=150, sigma_px=0), 0)
    m = prepare(pair.x1, pair.x2, 0)
    f = eight_point(m.points[:, :2], m.points[:, 2:]).reshape(9)
    wrong = squared_mismatch_distances(m.points, f)
    assert 7_800 <= len(wrong) <= 8_000
    assert wrong.min() > 1e4 * squared_distances(m.points, f).max()


@pytest.mark.parametrize("name", ESTIMATORS)
@pytest.mark.parametrize("count", [20, 60, 200])
def test_random_matches_are_rejected(name, count):
    size, reasons = np.array([1600.0, 1200.0]), []
    for seed in range(6):
        rng = np.random.default_rng([count, seed])
        fit = ESTIMATORS[name][0](*(rng.uniform(size=(2, count, 2)) * size), OPTIONS, seed)
        assert isinstance(fit, Rejected), fit.inlier_count
        reasons.append(fit.reason)
    assert set(reasons) <= {"inliers no better than chance", "too few inliers"}
    # the median looks at no threshold: what it finds may have no inliers to speak of
    assert reasons.count("inliers no better than chance") >= 3 or name == "lmeds"


@pytest.mark.parametrize(("true", "false"), [(20, 0), (20, 10), (25, 25), (30, 60), (60, 140)])
def test_true_pairs_are_kept(true, false):
    kept = 0
    for seed in range(10):
        size = {"points": true + false, "width": 1600, "height": 1200, "focal_px": 1500}
        pair = make_pair(PairOptions(outliers=false / (true + false), sigma_px=0.4, **size), seed)
        fit = ESTIMATORS["lev-ransac"][0](pair.x1, pair.x2, EpipolarSettings(), seed)
        kept += isinstance(fit, EpipolarFit) and bool(fit.inliers[pair.is_inlier].mean() > 0.7)
    assert kept >= 9
