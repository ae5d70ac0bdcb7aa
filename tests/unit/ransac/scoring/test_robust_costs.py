"""Penalties by hand, and early exits that never lose a better model."""

from functools import partial

import numpy as np
import pytest

from sfm_app.fundamental.pretests import BLOCK, NO_PRETEST, make_pretest
from sfm_app.fundamental.scores import (
    geman_mcclure,
    lmeds,
    msac,
    msac_linear,
    penalty,
    ransac,
    select,
    squared_distances,
    squared_sampson_distance,
)
from sfm_app.geometry.epipolar import cross_matrix, sampson_distance

SOFT = partial(geman_mcclure, scale=0.25)
SHIFT = cross_matrix([1.0, 0, 0]).reshape(9)


def matches_off_by(*pixels):
    """Matches of a shift along x whose Sampson distances are the given ones."""
    y = np.asarray(pixels) * np.sqrt(2)
    return np.asfortranarray(np.column_stack([np.arange(len(y)), np.zeros(len(y)), np.arange(len(y)) + 5.0, y]))


def test_distances_agree_with_the_reference():
    rng = np.random.default_rng(0)
    points, F = np.asfortranarray(rng.normal(size=(50, 4))), rng.normal(size=(3, 3))

    squared = squared_distances(points, F.reshape(9))

    np.testing.assert_allclose(np.sqrt(squared), sampson_distance(F, points[:, :2], points[:, 2:]), rtol=1e-9)
    assert squared_sampson_distance(np.zeros(9), 1.0, 2.0, 3.0, 4.0) == np.inf


@pytest.mark.parametrize(
    ("score", "expected"),
    [
        (ransac, 0 + 0 + 1 + 1),
        (msac, 0 + 0.25 + 4 + 4),
        (msac_linear, 0 + 0.5 + 2 + 2),
        (lmeds, 2.5**2),
        (SOFT, 0 + 0.5 + 6.25 / 6.5 + 1e4 / (1e4 + 0.25)),
    ],
)
def test_penalties_by_hand(score, expected):
    points = matches_off_by(0, 0.5, 2.5, 100)
    assert penalty(points, 0, SHIFT, score(points, 2.0, None), np.inf, NO_PRETEST) == pytest.approx(expected)


@pytest.mark.parametrize("score", [ransac, msac, msac_linear, lmeds, SOFT])
def test_a_score_that_cannot_win_is_left(score):
    points = matches_off_by(*np.linspace(0, 4, 1000))
    loss = score(points, 2.0, None)
    full = penalty(points, 0, SHIFT, loss, np.inf, NO_PRETEST)

    assert penalty(points, 0, SHIFT, loss, full * 1.001, NO_PRETEST) == full
    assert penalty(points, 0, SHIFT, loss, full, NO_PRETEST) == np.inf


def test_a_match_at_the_threshold_is_an_inlier():
    on, beyond = matches_off_by(0.0), matches_off_by(2.0)
    at_two = np.sqrt(squared_distances(beyond, SHIFT)[0])
    assert penalty(on, 0, SHIFT, ransac(on, 0.0, None), np.inf, NO_PRETEST) == 0
    assert penalty(beyond, 0, SHIFT, ransac(beyond, at_two * (1 + 1e-9), None), np.inf, NO_PRETEST) == 0
    assert penalty(beyond, 0, SHIFT, ransac(beyond, at_two * (1 - 1e-9), None), np.inf, NO_PRETEST) == 1


def test_the_gate_turns_away_what_lacks_inliers_and_keeps_books():
    points = matches_off_by(*[9.0] * BLOCK, *[0.0] * 10 * BLOCK)
    loss = msac(points, 2.0, None)
    lenient, strict = (make_pretest(np.array([least]), BLOCK, random_start=False) for least in (0, 1))

    assert penalty(points, 0, SHIFT, loss, np.inf, lenient) == 4 * BLOCK
    assert penalty(points, 0, SHIFT, loss, np.inf, strict) == np.inf
    assert lenient.rejected.tolist() == [0, 0]
    assert strict.rejected.tolist() == [BLOCK, 0]


def test_a_gate_asks_after_its_own_stride():
    points = matches_off_by(0, 0, 9, 0, 0, 0)
    loss = msac(points, 2.0, None)
    for least, passes in [
        ([1, 2, 2], True),
        ([1, 2, 3], False),
        ([1, 2, 2, 3, 4, 5], True),
        ([0, 0, 0, 0, 0, 6], False),
    ]:
        turned = penalty(points, 0, SHIFT, loss, np.inf, make_pretest(np.array(least), 1, random_start=False))
        assert (turned < np.inf) == passes


@pytest.mark.parametrize("count", [1, 2, 9, 10, 1001])
def test_quickselect_agrees_with_sorting(count):
    rng = np.random.default_rng(count)
    for values in (rng.normal(size=count), rng.integers(0, 3, count).astype(float)):
        for rank in {0, count // 2, count - 1}:
            assert select(values.copy(), rank) == np.sort(values)[rank]


def test_a_soft_penalty_still_counts_inliers_for_the_gate():
    points = matches_off_by(*[1.9, 2.1] * BLOCK)
    for least, passes in ((BLOCK // 2, True), (BLOCK // 2 + 1, False)):
        found = penalty(
            points,
            0,
            SHIFT,
            SOFT(points, 2.0, None),
            np.inf,
            make_pretest(np.array([least]), BLOCK, random_start=False),
        )
        assert (found < np.inf) == passes


def test_a_match_at_infinity_costs_the_most():
    points = matches_off_by(0.0)
    nothing = np.zeros(9)
    for score, worst in ((ransac, 1.0), (msac, 4.0), (msac_linear, 2.0), (SOFT, 1.0)):
        assert penalty(points, 0, nothing, score(points, 2.0, None), np.inf, NO_PRETEST) == worst


@pytest.mark.parametrize("start", [0, 3, 9])
def test_a_random_start_counts_every_match_once(start):
    points = matches_off_by(*np.linspace(0, 3, 10))
    circle = np.asfortranarray(np.vstack([points, points]))
    loss = msac(points, 2.0, None)
    everywhere = make_pretest(np.zeros(1, dtype=np.int64), 1, random_start=True)
    assert penalty(circle, start, SHIFT, loss, np.inf, everywhere) == pytest.approx(
        penalty(points, 0, SHIFT, loss, np.inf, NO_PRETEST)
    )
