"""Regression diagnostics against their textbook definitions."""

import numpy as np
import pytest

from sfm_app.fundamental.leverage import (
    PARAMETERS,
    cook_distances,
    leverages,
    mad_sigma,
    prior_validity,
    priors,
    studentized_residuals,
)
from sfm_app.fundamental.points import prepare
from sfm_app.geometry.epipolar import eight_point
from sfm_app.synthetic.correspondences import PairOptions, make_pair

TWO_PIXELS = 2.0 / 140  # in units of the spread of points in photos of 512 px


def design(points):
    h1, h2 = (np.column_stack([points[:, k : k + 2], np.ones(len(points))]) for k in (0, 2))
    return (h2[:, :, None] * h1[:, None, :]).reshape(-1, 9)


def scene(outliers=0.3, seed=0, points=200):
    pair = make_pair(PairOptions(points=points, outliers=outliers), seed)
    m = prepare(pair.x1, pair.x2, seed)
    good = np.empty(points, dtype=bool)
    good[m.rows] = pair.is_inlier
    F = eight_point(m.points[good, :2], m.points[good, 2:])
    return m.points, F.reshape(9), good


def test_leverages_are_the_hat_diagonal_of_the_tangent_regression():
    points, f, good = scene()
    X = design(points) @ np.linalg.svd(f[None])[2][1:].T

    h = leverages(points, f, good)

    inside = X[good]
    hat = inside @ np.linalg.inv(inside.T @ inside) @ inside.T
    np.testing.assert_allclose(h[good], np.diag(hat), rtol=1e-6)
    assert h[good].sum() == pytest.approx(PARAMETERS)
    assert ((h >= 0) & (h <= 1)).all()


def test_leverage_of_an_outsider_is_the_one_it_would_have():
    points, f, good = scene()
    outsider = np.flatnonzero(~good)[0]
    joined = good.copy()
    joined[outsider] = True
    assert leverages(points, f, good)[outsider] == pytest.approx(leverages(points, f, joined)[outsider])


def test_leverages_do_not_depend_on_the_frame():
    # exact matches, so that f spans the null space in every frame
    pair = make_pair(PairOptions(points=50), 1)
    x1, x2, fitted = pair.exact_x1, pair.exact_x2, np.ones(50, dtype=bool)
    plain = prepare(x1, x2, 0)
    zoomed = np.asfortranarray(plain.points * [3, 3, 0.5, 0.5] + [1, 1, -2, -2])
    found = [
        leverages(points, eight_point(points[:, :2], points[:, 2:]).reshape(9), fitted)
        for points in (plain.points, zoomed)
    ]
    np.testing.assert_allclose(found[0], found[1], atol=1e-6)


def test_directions_without_support_give_leverage_one():
    points, f, _ = scene()
    few = np.zeros(len(points), dtype=bool)
    few[:5] = True
    h = leverages(points, f, few)
    np.testing.assert_allclose(h[few], 1, atol=1e-3)
    assert np.median(h[~few]) > 0.999


def test_cook_distance_is_what_deletion_does():
    rng = np.random.default_rng(2)
    X, y = rng.normal(size=(40, PARAMETERS)), rng.normal(size=40)
    beta = np.linalg.lstsq(X, y, rcond=None)[0]
    hat = np.diag(X @ np.linalg.inv(X.T @ X) @ X.T)
    residuals = y - X @ beta
    s2 = residuals @ residuals / (40 - PARAMETERS)
    moved = np.array(
        [X @ (np.linalg.lstsq(np.delete(X, i, 0), np.delete(y, i), rcond=None)[0] - beta) for i in range(40)]
    )
    studentised = residuals / np.sqrt(s2 * (1 - hat))

    np.testing.assert_allclose(cook_distances(studentised, hat), (moved**2).sum(axis=1) / (PARAMETERS * s2), rtol=1e-9)


def test_studentised_residuals_have_unit_variance():
    rng = np.random.default_rng(3)
    X = rng.normal(size=(500, PARAMETERS))
    hat = X @ np.linalg.inv(X.T @ X) @ X.T
    residuals = (np.eye(500) - hat) @ rng.normal(scale=7.0, size=500)
    d = studentized_residuals(residuals, np.diag(hat), np.ones(500, dtype=bool))
    assert 0.9 < d.std() < 1.1


def test_priors_by_hand():
    assert priors(np.array([0.0, 1.0, 2.0]), 1.0) == pytest.approx(np.exp([0, -0.5, -2]))
    assert priors(np.array([1.0, 2.0]), 1.0) == pytest.approx([1, np.exp(-1.5)])
    assert priors(np.array([0.0, 3.0, 0.0]), 0.0).tolist() == [1, 0, 1]
    assert priors(np.array([0.0, 1e300]), 1e-300).tolist() == [1, 0]


def test_mad_of_a_gaussian_is_its_deviation():
    values = np.random.default_rng(4).normal(scale=3, size=20_000)
    assert 2.9 < mad_sigma(values) < 3.1
    assert mad_sigma(np.empty(0)) == 0


@pytest.mark.parametrize("sigma_from_inliers", [True, False])
@pytest.mark.parametrize("seed", range(3))
def test_priors_tell_inliers_from_outliers(seed, sigma_from_inliers):
    points, f, good = scene(outliers=0.4, seed=seed)

    p = prior_validity(points, f, TWO_PIXELS, sigma_from_inliers=sigma_from_inliers)

    assert p.max() == 1
    assert p.min() >= 0
    assert np.mean(p[good]) > 0.5
    assert np.mean(p[~good]) < 0.2
