"""Matches are checked once, freed of repeats, shuffled and scaled."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sfm_app.fundamental.points import check_points, prepare
from sfm_app.fundamental.scores import squared_distances
from sfm_app.geometry.epipolar import sampson_distance


@pytest.mark.parametrize(
    ("x1", "x2", "message"),
    [
        ([1.0, 2.0], [[1.0, 2.0]], r"x1 must have shape \(N, 2\), got \(2,\)"),
        ([[1.0, 2.0]], [[1.0, 2.0, 3.0]], r"x2 must have shape \(N, 2\), got \(1, 3\)"),
        ([[1.0, 2.0]], np.empty((0, 2)), "row by row, got 1 and 0"),
        ([[np.nan, 2.0]], [[1.0, 2.0]], "x1 holds 1 points that are not finite"),
        ([[1.0, 2.0]], [[np.inf, 2.0]], "x2 holds 1 points that are not finite"),
        ([[1.1e15, 2.0]], [[1.0, 2.0]], r"x1 must lie within 1e\+15 px, got 1.1e\+15"),
        ([[1.0, 2.0]], [[2.0, -1e300]], r"x2 must lie within 1e\+15 px, got 1.0e\+300"),
        ([["a", "b"]], [[1.0, 2.0]], "x1 must hold real numbers"),
        ([[1j, 2.0]], [[1.0, 2.0]], "x1 must hold real numbers"),
    ],
)
def test_bad_points_are_refused(x1, x2, message):
    with pytest.raises(ValueError, match=message):
        check_points(x1, x2)


@pytest.mark.parametrize("dtype", [np.int32, np.uint16, np.float32, np.float64])
def test_any_real_type_becomes_contiguous_float64(dtype):
    x = np.arange(40, dtype=dtype).reshape(4, 10).T[:, ::2]

    y1, y2 = check_points(x, x.tolist())

    for y in (y1, y2):
        assert y.dtype == np.float64
        assert y.flags.c_contiguous
        np.testing.assert_array_equal(y, x)


def test_no_points_are_fine():
    assert check_points(np.empty((0, 2)), np.empty((0, 2)))[0].shape == (0, 2)
    assert prepare(np.empty((0, 2)), np.empty((0, 2)), 0).points.shape == (0, 4)


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


def test_seed_decides_the_order():
    x = np.random.default_rng(0).uniform(0, 100, (50, 4))
    first, again, other, negative = (prepare(x[:, :2], x[:, 2:], seed) for seed in (1, 1, 2, -1))

    np.testing.assert_array_equal(first.points, again.points)
    assert not np.array_equal(first.points, other.points)
    assert not np.array_equal(first.points, negative.points)
