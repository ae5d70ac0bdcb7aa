"""Penalties by hand, and early exits that never lose a better model."""

import numpy as np
import pytest

from sfm_app.geometry.distances import sampson_distance
from sfm_app.geometry.epipolar import cross_matrix
from sfm_app.ransac.scoring import (
    BLOCK,
    MSAC,
    MSAC_LINEAR,
    RANSAC,
    bail_out_table,
    penalty,
    squared_distances,
    squared_sampson,
)

NO_TABLE = np.zeros(0, dtype=np.int64)
SHIFT = cross_matrix([1.0, 0, 0]).reshape(9)


def matches_off_by(*pixels):
    """Matches of a shift along x whose Sampson distances are the given ones."""
    y = np.asarray(pixels) * np.sqrt(2)
    return np.column_stack([np.arange(len(y)), np.zeros(len(y)), np.arange(len(y)) + 5.0, y])


def test_distances_agree_with_the_reference():
    rng = np.random.default_rng(0)
    points, F = rng.normal(size=(50, 4)), rng.normal(size=(3, 3))

    squared = squared_distances(points, F.reshape(9))

    np.testing.assert_allclose(np.sqrt(squared), sampson_distance(F, points[:, :2], points[:, 2:]), rtol=1e-9)
    assert squared_sampson(np.zeros(9), 1.0, 2.0, 3.0, 4.0) == np.inf


@pytest.mark.parametrize(
    ("kind", "expected"),
    [(RANSAC, 0 + 0 + 1 + 1), (MSAC, 0 + 0.25 + 4 + 4), (MSAC_LINEAR, 0 + 0.5 + 2 + 2)],
)
def test_penalties_by_hand(kind, expected):
    points = matches_off_by(0, 0.5, 2.5, 100)
    assert penalty(points, SHIFT, kind, 2.0, np.inf, NO_TABLE) == pytest.approx(expected)


@pytest.mark.parametrize("kind", [RANSAC, MSAC, MSAC_LINEAR])
def test_a_score_that_cannot_win_is_left(kind):
    points = matches_off_by(*np.linspace(0, 4, 1000))
    full = penalty(points, SHIFT, kind, 2.0, np.inf, NO_TABLE)

    assert penalty(points, SHIFT, kind, 2.0, full * 1.001, NO_TABLE) == full
    assert penalty(points, SHIFT, kind, 2.0, full, NO_TABLE) == np.inf


def test_bail_out_leaves_when_inliers_are_missing():
    points = matches_off_by(*[9.0] * BLOCK, *[0.0] * 10 * BLOCK)
    assert penalty(points, SHIFT, MSAC, 2.0, np.inf, np.array([0])) < np.inf
    assert penalty(points, SHIFT, MSAC, 2.0, np.inf, np.array([1])) == np.inf


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
