"""The meeting point of thesis (5.33)."""

import numpy as np
import pytest

from sfm_app.selfcal.consensus import meeting_point

X = np.linspace(0, 1, 101)


def lines_through(x0, y0, slopes):
    return np.array([y0 + slope * (X - x0) for slope in slopes])


def test_finds_where_curves_meet():
    found = meeting_point(lines_through(0.3, 1.0, [-1, -0.5, 0.4, 1.2]), 3.0, 0.1)
    assert X[found.sample] == pytest.approx(0.3)
    assert found.value == pytest.approx(1.0)
    assert found.support == pytest.approx(1)


def test_outlying_curves_do_not_pull():
    curves = np.vstack([lines_through(0.3, 1.0, [-1, -0.5, 0.4, 1.2]), np.full((3, 101), [[2.0], [2.5], [0.2]])])
    found = meeting_point(curves, 3.0, 0.05)
    assert X[found.sample] == pytest.approx(0.3)
    assert 0.5 < found.support < 0.6  # three of six others


def test_score_is_thesis_5_33_as_a_maximum():
    curves = np.random.default_rng(0).uniform(-0.5, 3.5, (6, 20))
    rho = np.exp(-np.abs(curves[:, None, :] - curves[None, :, :]) / 0.3).sum(axis=1) - 1
    allowed = np.where((curves > 0) & (curves < 3), rho, -1)
    k, j = np.unravel_index(np.argmax(allowed), allowed.shape)

    found = meeting_point(curves, 3.0, 0.3)

    assert (found.sample, found.value) == (j, curves[k, j])
    assert found.support == pytest.approx(rho[k, j] / 5)


@pytest.mark.parametrize("count", [0, 1])
def test_one_curve_meets_nothing(count):
    assert meeting_point(np.ones((count, 5)), 3.0, 0.1) is None


def test_samples_out_of_range_are_no_answer():
    assert meeting_point(np.array([[0.0, -1, 3], [0, -1, 3]]), 3.0, 0.1) is None
    assert meeting_point(np.array([[0.0, -1, 2.9], [0, -1, 1]]), 3.0, 0.1).sample == 2
