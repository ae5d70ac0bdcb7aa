"""Products of the design matrix, block by block, against the dense ones."""

import numpy as np
import pytest

from sfm_app.fundamental.solvers import LANES, design_row, quadratic_forms, weighted_gram

SIZES = [2, 7, LANES - 1, LANES, LANES + 1, 3 * LANES, 200]


def dense(points):
    h1, h2 = (np.column_stack([points[:, k : k + 2], np.ones(len(points))]) for k in (0, 2))
    return (h2[:, :, None] * h1[:, None, :]).reshape(-1, 9)


def matches(count):
    return np.asfortranarray(np.random.default_rng(count).normal(size=(count, 4)))


def test_a_row_is_the_constraint():
    rng = np.random.default_rng(0)
    point, F, row = rng.normal(size=4), rng.normal(size=(3, 3)), np.empty(9)
    design_row(point, row)
    assert row @ F.reshape(9) == pytest.approx(np.append(point[2:], 1) @ F @ np.append(point[:2], 1))
    np.testing.assert_allclose(row, dense(point[None])[0])


@pytest.mark.parametrize("count", SIZES)
@pytest.mark.parametrize("share", [0.0, 0.3, 1.0])
def test_gram_is_the_weighted_product(count, share):
    points, rng = matches(count), np.random.default_rng(count)
    weights = rng.uniform(size=count) * (rng.uniform(size=count) < share)
    A = dense(points)

    gram = weighted_gram(points, weights)

    np.testing.assert_allclose(gram, (A.T * weights) @ A, rtol=1e-12, atol=1e-12)
    np.testing.assert_array_equal(gram, gram.T)


def test_matches_without_weight_may_be_anything():
    points, weights = matches(100), np.ones(100)
    weights[40:45] = 0
    expected = weighted_gram(points, weights)
    points[40:45] = np.nan
    np.testing.assert_array_equal(weighted_gram(points, weights), expected)


@pytest.mark.parametrize("count", SIZES)
@pytest.mark.parametrize("directions", [1, 8])
def test_forms_are_squared_lengths(count, directions):
    points = matches(count)
    whitening = np.random.default_rng(directions).normal(size=(9, directions))

    forms = quadratic_forms(points, whitening)

    np.testing.assert_allclose(forms, ((dense(points) @ whitening) ** 2).sum(axis=1), rtol=1e-12, atol=1e-12)
