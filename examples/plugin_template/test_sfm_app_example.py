"""Tests of the example alone; those that every estimator passes are in tests/contract of sfm-app."""

import pickle
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from sfm_app_example import fit_example

import sfm_app
from sfm_app.settings import EpipolarSettings
from sfm_app.synthetic.correspondences import PairOptions, make_pair

NAME = "example-msac"
OPTIONS = EpipolarSettings(max_trials=2000)


def test_it_is_found_by_name():
    pair = make_pair(PairOptions(points=300, outliers=0.2, sigma_px=0.5), seed=1)

    found = sfm_app.estimate_fundamental(pair.x1, pair.x2, method=NAME)

    np.testing.assert_array_equal(found.F, fit_example(pair.x1, pair.x2, EpipolarSettings(), 0).F)


@pytest.mark.parametrize("seed", range(3))
def test_it_tells_right_matches_from_wrong_ones(seed):
    pair = make_pair(PairOptions(points=500, outliers=0.4, sigma_px=0.5), seed)

    found = fit_example(pair.x1, pair.x2, OPTIONS, 0)

    assert found.inliers[pair.is_inlier].mean() > 0.9
    assert found.inliers[~pair.is_inlier].mean() < 0.1
    assert 0.4 < found.rms_px < 0.6  # the noise that was put in
    assert found.trials < OPTIONS.max_trials


def test_noise_is_rejected_with_a_reason():
    rng = np.random.default_rng(0)

    found = fit_example(rng.uniform(0, 1000, (100, 2)), rng.uniform(0, 1000, (100, 2)), OPTIONS, 0)

    assert not found and found.reason


def test_same_seed_same_bytes_in_any_thread():
    pair = make_pair(PairOptions(points=300, outliers=0.2, sigma_px=0.5), seed=2)

    with ThreadPoolExecutor(4) as pool:
        runs = set(pool.map(lambda _: pickle.dumps(fit_example(pair.x1, pair.x2, OPTIONS, 7)), range(4)))

    assert len(runs) == 1
