"""Checks of matches, and the assessment of a fundamental matrix."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sfm_app.fundamental.estimate import assess_fundamental, estimate_with
from sfm_app.fundamental.points import check_points, prepare
from sfm_app.fundamental.scores import squared_distances
from sfm_app.geometry.epipolar import sampson_distance, to_unit_norm
from sfm_app.settings import EpipolarSettings
from sfm_app.synthetic.correspondences import PairOptions, make_pair
from sfm_app.types import EpipolarFit, Rejected

OPTIONS = EpipolarSettings(max_error_px=2.0)
PAIR = make_pair(PairOptions(points=400, outliers=0.3, sigma_px=0.5), 2)
RANK_ONE = np.outer([1.0, 2, 3], [3, 2, 1])


def judge_with(F):
    """`estimate_with` asks for F about the middle of each view."""

    def find(x1, x2, options, seed):
        middle1, middle2 = np.mean(PAIR.x1, axis=0) - x1.mean(axis=0), np.mean(PAIR.x2, axis=0) - x2.mean(axis=0)
        to1, to2 = (np.array([[1, 0, x], [0, 1, y], [0, 0, 1]]) for x, y in (middle1, middle2))
        return to2.T @ F @ to1, 7

    return estimate_with(find, PAIR.x1, PAIR.x2, OPTIONS, 0)


@pytest.mark.parametrize("scale", [1.0, -1e-200, 1e200])
def test_the_true_matrix_is_accepted_at_any_scale(scale):
    for found, trials in (
        (assess_fundamental(PAIR.x1, PAIR.x2, scale * PAIR.F, OPTIONS), 1),
        (judge_with(scale * PAIR.F), 7),
    ):
        np.testing.assert_allclose(to_unit_norm(found.F), to_unit_norm(PAIR.F), atol=1e-12)
        np.testing.assert_array_equal(found.inliers, sampson_distance(PAIR.F, PAIR.x1, PAIR.x2) <= 2.0)
        assert found.trials == trials
        assert found.degeneracy == ""
        assert found.priors[PAIR.is_inlier].mean() > found.priors[~PAIR.is_inlier].mean() + 0.3


def test_a_matrix_of_full_rank_is_brought_to_rank_two():
    bent = PAIR.F / np.linalg.norm(PAIR.F) + 1e-9 * np.eye(3)
    found = assess_fundamental(PAIR.x1, PAIR.x2, bent, OPTIONS)
    assert np.linalg.svd(bent, compute_uv=False)[2] > 1e-10
    assert np.linalg.svd(found.F, compute_uv=False)[2] < 1e-15


@pytest.mark.parametrize("F", [np.zeros((3, 3)), np.full((3, 3), np.nan), np.diag([1, np.inf, 0]), RANK_ONE])
def test_what_is_no_fundamental_matrix_is_rejected(F):
    assert assess_fundamental(PAIR.x1, PAIR.x2, F, OPTIONS) == Rejected("no model found")
    assert estimate_with(lambda *_: (F, 1), PAIR.x1, PAIR.x2, OPTIONS, 0) == Rejected("no model found")


def test_a_wrong_matrix_is_rejected_with_the_reason():
    other = make_pair(PairOptions(points=400), 3).F
    assert assess_fundamental(PAIR.x1, PAIR.x2, other, OPTIONS).reason in (
        "too few inliers",
        "inliers no better than chance",
    )
    assert assess_fundamental(PAIR.x1[:15], PAIR.x2[:15], PAIR.F, OPTIONS) == Rejected("too few matches")
    assert estimate_with(lambda *_: None, PAIR.x1, PAIR.x2, OPTIONS, 0) == Rejected("no model found")


def test_wrong_shapes_are_refused():
    with pytest.raises(ValueError, match=r"F must have shape \(3, 3\)"):
        assess_fundamental(PAIR.x1, PAIR.x2, np.zeros((9, 3)), OPTIONS)
    with pytest.raises(ValueError, match=r"F must have shape \(3, 3\)"):
        estimate_with(lambda *_: (np.zeros(9), 1), PAIR.x1, PAIR.x2, OPTIONS, 0)
    with pytest.raises(ValueError, match="pair up"):
        assess_fundamental(PAIR.x1, PAIR.x2[:50], PAIR.F, OPTIONS)


def test_a_search_sees_distinct_centered_matches_in_the_order_of_the_seed():
    seen = []

    def find(x1, x2, options, seed):
        seen.append((x1, x2, options, seed))

    repeated = [np.tile(x + 1e6, (2, 1)) for x in (PAIR.x1, PAIR.x2)]
    for seed in (4, 5, 4):
        estimate_with(find, *repeated, OPTIONS, seed)

    x1, x2, options, seed = seen[0]
    assert (x1.shape, x2.shape, options, seed) == ((400, 2), (400, 2), OPTIONS, 4)
    assert x1.flags.c_contiguous and x2.flags.c_contiguous
    np.testing.assert_allclose([np.mean(x1 > 0, axis=0), np.mean(x2 > 0, axis=0)], 0.5, atol=0.01)
    np.testing.assert_allclose(np.sort(np.ptp(x1, axis=0)), np.sort(np.ptp(PAIR.x1, axis=0)), rtol=1e-6)
    np.testing.assert_array_equal(seen[0][0], seen[2][0])
    assert not np.array_equal(seen[0][0], seen[1][0])


def test_too_few_matches_are_not_searched():
    def find(*_):
        raise AssertionError("not to be called")

    found = estimate_with(find, np.tile(PAIR.x1[:15], (9, 1)), np.tile(PAIR.x2[:15], (9, 1)), OPTIONS, 0)

    assert found == Rejected("too few matches")
    assert not isinstance(found, EpipolarFit)


def test_real_numbers_of_any_type_and_none_become_contiguous_float64():
    for dtype in (np.int32, np.uint16, np.float32, np.float64):
        x = np.arange(40, dtype=dtype).reshape(4, 10).T[:, ::2]
        for y in check_points(x, x.tolist()):
            assert y.dtype == np.float64 and y.flags.c_contiguous
            np.testing.assert_array_equal(y, x)
    nothing = np.empty((0, 2))
    assert prepare(*check_points(nothing, nothing), 0).points.shape == (0, 4)


@given(seed=st.integers(0, 1000), repeats=st.integers(0, 30))
def test_repeats_leave_and_rows_find_the_way_back(seed, repeats):
    rng = np.random.default_rng(seed)
    x = rng.uniform(0, 1000, (20, 4))
    x = np.vstack([x, x[rng.integers(20, size=repeats)]])
    m = prepare(x[:, :2], x[:, 2:], seed)
    assert m.points.shape == (20, 4)
    np.testing.assert_allclose(m.points[m.rows] * m.unit_px + m.center, x, atol=1e-9)
    assert 0.7 < np.sqrt((m.points**2).mean()) < 1.4
    np.testing.assert_allclose(np.mean(m.points < 0, axis=0), 0.5)
    assert m.points.flags.f_contiguous


def test_absurd_matches_and_repeats_do_not_move_the_frame():
    x = np.random.default_rng(0).uniform(0, 1000, (100, 4))
    plain = prepare(x[:, :2], x[:, 2:], 0)
    absurd = np.vstack([x, np.tile(x[:1], (50, 1)), [[1e10, 5, -1e12, 0], [1e15, 1e15, 1e15, 1e15]]])
    m = prepare(absurd[:, :2], absurd[:, 2:], 0)
    assert len(m.points) == 102
    assert m.unit_px == pytest.approx(plain.unit_px, rel=0.1)
    assert np.abs(m.center - plain.center).max() < 0.1 * m.unit_px
    assert plain.unit_px == pytest.approx(500 / 3**0.5, rel=0.1)


@pytest.mark.parametrize("spread", [0, 1, 4])
def test_any_extent_has_a_unit(spread):
    x = np.full((20, 4), 7.0)
    x[:spread, 0] += 100 * np.arange(1, spread + 1)
    m = prepare(x[:, :2], x[:, 2:], 0)
    assert m.points.shape == (spread + 1, 4)
    assert m.unit_px == 1 if spread == 0 else 10 < m.unit_px < 300


def test_matches_that_share_one_point_stay_apart():
    x1, x2 = np.full((10, 2), 5.0), np.arange(20.0).reshape(10, 2)
    assert len(prepare(x1, x2, 0).points) == 10


def test_distances_are_those_of_pixels():
    rng = np.random.default_rng(0)
    x1, x2, F = rng.uniform(0, 1000, (30, 2)), rng.uniform(0, 1500, (30, 2)), rng.normal(size=(3, 3))
    m = prepare(x1, x2, 0)
    in_units = np.sqrt(squared_distances(m.points, F.reshape(9)))[m.rows]
    np.testing.assert_allclose(in_units * m.unit_px, sampson_distance(m.to_pixels(F), x1, x2), rtol=1e-9)
