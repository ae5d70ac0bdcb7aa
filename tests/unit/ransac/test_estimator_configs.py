"""The table of estimators: what is special about each of them."""

import math
import pickle

import numpy as np
import pytest

from sfm_app.fundamental import ESTIMATORS
from sfm_app.fundamental.loop import search
from sfm_app.fundamental.points import prepare
from sfm_app.fundamental.recipes import RECIPES, classical_estimator, median_sigma
from sfm_app.geometry.epipolar import sampson_distance
from sfm_app.settings import EpipolarSettings
from sfm_app.synthetic.correspondences import PairOptions, make_pair

OPTIONS = EpipolarSettings(max_error_px=1.96, max_trials=20_000)


def trials_of(name, outliers, seeds=range(5)):
    found = []
    for seed in seeds:
        pair = make_pair(PairOptions(points=600, outliers=outliers), seed)
        found.append(search(prepare(pair.x1, pair.x2, seed), OPTIONS, seed, RECIPES[name][0]).trials)
    return np.array(found)


def test_every_estimator_is_registered_with_a_line_about_it():
    assert set(ESTIMATORS) == {
        *("lev-ransac", "lev-ransac-thesis", "lev-ransac-sprt", "lev-ransac-tdd", "res-ransac"),
        *("mlesac", "msac", "ransac", "ransac-sprt", "ransac-tdd", "lmeds"),
    }
    assert all(10 < len(about) < 120 for _, about in ESTIMATORS.values())


def test_estimators_pickle_by_name():
    fit = classical_estimator("mlesac")
    assert pickle.loads(pickle.dumps(fit)) is fit  # noqa: S301 - our own bytes
    assert fit.__name__ == "mlesac"


def test_tdd_needs_the_trials_that_its_test_costs():
    share = 1 - 0.3 - 0.08  # of a seven-point model: noise hides some inliers
    assert 1.1 < np.median(trials_of("ransac-tdd", 0.3)) / np.median(trials_of("ransac", 0.3)) < 1.8 / share


def test_sprt_costs_few_trials():
    assert 0.7 < np.median(trials_of("ransac-sprt", 0.4)) / np.median(trials_of("ransac", 0.4)) < 1.4


def test_guided_samples_save_trials_at_high_contamination():
    # thesis 4.8: LEV-RANSAC needs the fewest, RES-RANSAC comes between it and plain sampling
    plain, residuals, leverages = (trials_of(n, 0.5).mean() for n in ("mlesac", "res-ransac", "lev-ransac-thesis"))
    assert leverages < residuals / 3
    assert residuals < 0.8 * plain


def test_lmeds_draws_for_half_outliers_and_holds_up_to_there():
    expected = math.ceil(math.log(1 - OPTIONS.confidence) / math.log(1 - 0.5**7))
    assert (trials_of("lmeds", 0.1, range(2)) == expected).all()
    for seed in range(3):
        pair = make_pair(PairOptions(points=600, outliers=0.4), seed)
        fit = classical_estimator("lmeds")(pair.x1, pair.x2, OPTIONS, seed)
        assert sampson_distance(fit.F, pair.exact_x1, pair.exact_x2).mean() < 0.4


@pytest.mark.parametrize("scale", [0.1, 1.7])
def test_the_median_gives_the_scale_of_the_noise(scale):
    noise = np.random.default_rng(1).normal(scale=scale, size=20_000)
    assert median_sigma(noise**2) == pytest.approx(scale, rel=0.03)
    # few matches: seven of them are met exactly
    assert median_sigma(np.full(12, scale**2)) == pytest.approx(1.4826 * 2 * scale)
    assert median_sigma(np.zeros(3)) == 0
