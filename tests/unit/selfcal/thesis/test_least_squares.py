"""Levenberg-Marquardt on many starts at once."""

import numpy as np
import pytest
from scipy.optimize import least_squares

from sfm_app.selfcal.pairs import prepare
from sfm_app.selfcal.thesis.constraint_forms import Halves, huang_faugeras_equations
from sfm_app.selfcal.thesis.least_squares import find_minima, fit_camera
from sfm_app.selfcal.thesis.verdict import CameraParameters
from sfm_app.types import CameraPairs


def in_widths(made):
    return prepare(CameraPairs.from_Fs(made.Fs, made.size), unit_px=made.size[0], origin_px=(0.0, 0.0))


def truth(made):
    return np.array([made.K[0, 0], made.K[1, 1], made.K[0, 2], made.K[1, 2]]) / made.size[0]


@pytest.mark.parametrize("count", [3, 6])
def test_exact_pairs_lead_to_the_exact_camera(views, count):
    made = views(count, seed=1, noise=0.0, focal=1200, aspect=0.9, center=(560, 330))
    found = fit_camera(in_widths(made), CameraParameters.initial(0.75), np.ones(count * (count - 1) // 2))
    np.testing.assert_allclose(found, truth(made), atol=1e-5)


def test_it_stops_where_scipy_does(views):
    made = views(6, seed=2, noise=5e-3)
    pairs, weights = in_widths(made), np.linspace(0.1, 1, 15)
    halves = Halves.from_fundamentals(pairs.F)

    def residuals(camera):
        return (np.sqrt(weights)[:, None] * huang_faugeras_equations(halves, camera)).ravel()

    expected = least_squares(residuals, [1.0, 1.0, 0.5, 0.375], method="lm", xtol=1e-12, ftol=1e-12)
    found = fit_camera(pairs, CameraParameters.initial(0.75), weights)
    np.testing.assert_allclose(found, expected.x, atol=1e-4)
    assert np.abs(np.array(found) - truth(made)).max() > 1e-3


def test_the_scale_of_the_weights_has_no_effect(views):
    pairs, weights = in_widths(views(5, noise=5e-3)), np.linspace(0.5, 1, 10)
    start = CameraParameters.initial(0.75)
    np.testing.assert_allclose(fit_camera(pairs, start, weights), fit_camera(pairs, start, 1e4 * weights), rtol=1e-6)


def test_a_pair_of_weight_zero_does_not_count(views, random_fundamentals):
    made = views(5, seed=3, noise=0.0)
    wrong = CameraPairs.from_Fs(np.concatenate([made.Fs, random_fundamentals(1)]), made.size)
    pairs = prepare(wrong, unit_px=1000.0, origin_px=(0.0, 0.0))
    start = CameraParameters.initial(0.75)
    np.testing.assert_allclose(fit_camera(pairs, start, np.r_[np.ones(10), 0.0]), truth(made), atol=1e-5)
    assert np.abs(np.array(fit_camera(pairs, start, np.ones(11))) - truth(made)).max() > 1e-2


def test_searches_side_by_side_are_as_if_alone(views):
    pairs = in_widths(views(5, noise=2e-3))
    halves, rng = Halves.from_fundamentals(pairs.F), np.random.default_rng(0)
    triples = np.array([[0, 1, 2], [3, 5, 9], [2, 4, 8], [1, 6, 7]])
    starts = np.column_stack([rng.uniform(0.5, 2, (4, 2)), rng.uniform(0.3, 0.6, (4, 2))])
    together = find_minima(halves[triples], np.ones((4, 3)), starts)
    for i in range(4):
        alone = find_minima(halves[triples[i : i + 1]], np.ones((1, 3)), starts[i : i + 1])
        np.testing.assert_allclose(together.cameras[i], alone.cameras[0], rtol=1e-6)
        assert together.sums[i] == pytest.approx(alone.sums[0], rel=1e-6)


def test_where_nothing_depends_on_the_camera_it_stays(views):
    pairs = in_widths(views(4, noise=0.0, motion=views.translation))
    np.testing.assert_allclose(
        fit_camera(pairs, CameraParameters.initial(0.75), np.ones(6)), [1, 1, 0.5, 0.375], atol=1e-6
    )


def test_it_never_ends_above_its_start(views, random_fundamentals):
    Fs = random_fundamentals(12, 4)
    pairs = prepare(CameraPairs.from_Fs(Fs, (1000, 750)), unit_px=1000.0, origin_px=(0.0, 0.0))
    start = CameraParameters.initial(0.75)
    end = fit_camera(pairs, start, np.ones(12))
    sums = [
        np.sum(huang_faugeras_equations(Halves.from_fundamentals(pairs.F), np.array(camera)) ** 2)
        for camera in (start, end)
    ]
    assert sums[1] < sums[0]
    assert np.all(np.isfinite(end))
    assert min(end[:2]) > 0
