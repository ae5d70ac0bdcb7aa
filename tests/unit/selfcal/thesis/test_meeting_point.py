"""The meeting point of thesis (5.33)."""

import numpy as np
import pytest

from sfm_app.selfcal.pairs import prepare
from sfm_app.selfcal.thesis.curves import focal_curves, usable_curves
from sfm_app.selfcal.thesis.zero_curves import meeting_point, meeting_points
from sfm_app.types import CameraPairs

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


def test_two_cameras_are_two_peaks(views):
    for seed, focals in ((1, (700, 1500)), (2, (800, 1200)), (7, (800, 1200)), (6, (900, 2000))):
        Fs = np.concatenate([views(5, seed + 100 * i, noise=5e-4, focal=f).Fs for i, f in enumerate(focals)])
        found = focal_peaks(Fs)
        assert len(found) >= 2
        np.testing.assert_allclose(sorted(found[:2]), focals, rtol=0.05)


def test_one_camera_is_one_peak(views):
    for seed in (2, 3, 4):
        found = focal_peaks(views(5, seed, noise=5e-4, focal=1100).Fs)
        assert found[0] == pytest.approx(1100, rel=0.05)
        assert len(found) == 1


def focal_peaks(Fs):
    """Focals sqrt(fx fy) in pixels, the best supported first."""
    pairs = prepare(CameraPairs.from_Fs(Fs, (1000, 750)), unit_px=1000.0, origin_px=(0.0, 0.0))
    fx = 3 * np.arange(1, 201) / 200
    curves = usable_curves(focal_curves(pairs, fx, (0.5, 0.375)), 3.0)
    return [1000 * np.sqrt(fx[m.sample] * m.value) for m in meeting_points(curves, fx, (0.3, 3.0), 0.1)]


def test_peaks_are_apart_and_end_at_the_limits():
    sweep = np.linspace(0.1, 3, 30)
    at = [np.abs(sweep - place) for place in (0.2, 1.0, 1.1, 2.0)]
    near = np.minimum.reduce(at)
    # two curves that meet at 0.2, 1.0, 1.1 and 2.0, all at 1.5 or so
    curves = np.array([1.5 + 0 * sweep, 1.5 + near])
    found = meeting_points(curves, sweep, (0.3, 3.0), 0.05)
    assert [round(float(sweep[m.sample]), 1) for m in found] == [1.0, 2.0]
    assert all(m.support > 0.99 for m in found)


def test_no_peaks_of_a_single_curve():
    assert meeting_points(np.ones((1, 5)), np.linspace(0.5, 1, 5), (0.3, 3.0), 0.1) == []
