"""MLESAC: the likelihood of 3.5, and the share of inliers that maximizes it."""

import math

import numpy as np
import pytest

from sfm_app.fundamental.pretests import NO_PRETEST
from sfm_app.fundamental.scores import SIGMAS, inlier_share, mlesac, outlier_window, penalty, squared_distances
from sfm_app.geometry.epipolar import cross_matrix

SHIFT = cross_matrix([1.0, 0, 0]).reshape(9) / np.sqrt(2)
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


@pytest.mark.parametrize("best", [None, SHIFT])
def test_penalty_is_the_log_likelihood_less_its_peak(best):
    rng = np.random.default_rng(2)
    y = np.concatenate([rng.normal(scale=SIGMA, size=200), rng.uniform(-50, 50, 300)])
    points = np.asfortranarray(rng.uniform(0, 100, (500, 4)))
    points[:, 3] = points[:, 1] + y * np.sqrt(2)
    r, w = np.sqrt(squared_distances(points, SHIFT)), outlier_window(points)
    gamma = 0.5 if best is None else inlier_share(r**2, SIGMA, w)

    def log_p(r):
        inlier = np.exp(-(r**2) / (2 * SIGMA**2)) / (SIGMA * math.sqrt(2 * math.pi))
        return np.log(gamma * inlier + (1 - gamma) / w)

    found = penalty(points, 0, SHIFT, mlesac(points, SIGMAS * SIGMA, best), np.inf, NO_PRETEST)

    assert found == pytest.approx(float((log_p(np.zeros(500)) - log_p(r)).sum()), rel=1e-9)
    assert best is None or 0.35 < gamma < 0.45


def test_window_is_the_diagonal_whatever_the_origin():
    points = np.array([[0, 0, 10, 10], [3, 4, 16, 18.0], [1, 1, 11, 11]])
    assert outlier_window(points) == pytest.approx((5 + 10) / 2)
    assert outlier_window(points - 100) == pytest.approx(7.5)
    assert outlier_window(np.zeros((3, 4))) > 0
