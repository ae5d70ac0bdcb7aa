"""Tests for PoseLib's estimators alone; those that all estimators pass are in tests/contract."""

import pytest

pytest.importorskip("sfm_app_poselib", reason="the plug-in is not installed: pip install -e plugins/poselib")

import numpy as np
import poselib
from sfm_app_poselib import fit_poselib

import sfm_app
from sfm_app.geometry.epipolar import sampson_distance
from sfm_app.settings import EpipolarSettings
from sfm_app.synthetic.correspondences import PairOptions, make_pair
from sfm_app.types import Rejected

PAIR = make_pair(PairOptions(points=1000, outliers=0.3, sigma_px=1.5), 1)


def options(**values):
    return EpipolarSettings(**{"max_error_px": 1.5, "max_trials": 3000, **values})


def test_it_is_found_by_name():
    settings = sfm_app.Settings(epipolar=options())
    found = sfm_app.estimate_fundamental(PAIR.x1, PAIR.x2, method="poselib", seed=3, settings=settings)
    np.testing.assert_array_equal(found.F, fit_poselib(PAIR.x1, PAIR.x2, options(), 3).F)


def test_the_threshold_is_a_sampson_distance_in_poselib():
    # few iterations of the final fit, so that the inliers are those of the returned matrix
    F, found = poselib.estimate_fundamental(
        PAIR.x1, PAIR.x2, {"max_epipolar_error": 1.5, "seed": 1}, {"max_iterations": 0}
    )
    inside = np.asarray(found["inliers"])
    distance = sampson_distance(F, PAIR.x1, PAIR.x2)
    assert 1.4 < distance[inside].max() < 1.501
    assert distance[~inside].min() > 1.499


def test_samples_are_counted_and_limited():
    assert 1000 <= fit_poselib(PAIR.x1, PAIR.x2, options(), 0).trials <= 3000
    assert fit_poselib(PAIR.x1, PAIR.x2, options(max_trials=40), 0).trials == 40


@pytest.mark.parametrize("F", [np.full((3, 3), np.nan), np.zeros((3, 3)), np.outer([1, 2, 3], [3, 2, 1])])
def test_what_is_no_fundamental_matrix_becomes_a_value(monkeypatch, F):
    monkeypatch.setattr(poselib, "estimate_fundamental", lambda *_: (F, {"num_inliers": 50, "iterations": 7}))
    assert fit_poselib(PAIR.x1, PAIR.x2, options(), 0) == Rejected("no model found")


def test_nothing_found_is_a_value(monkeypatch):
    monkeypatch.setattr(poselib, "estimate_fundamental", lambda *_: (PAIR.F, {"num_inliers": 0, "iterations": 7}))
    assert fit_poselib(PAIR.x1, PAIR.x2, options(), 0) == Rejected("no model found")
