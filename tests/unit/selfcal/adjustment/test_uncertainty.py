"""Standard deviations against the scatter of repeated photos."""

import numpy as np
import pytest

from sfm_app.selfcal.adjustment import Matches
from sfm_app.selfcal.calibrate_pairs import camera_uncertainty, covariance, fit_cameras, jackknife_deviations, key_pairs
from sfm_app.selfcal.pairs import calibration_from_parameters, parameters_from_calibration
from sfm_app.selfcal.priors import CameraPriors

pytestmark = pytest.mark.slow

SIDE = 1000.0
TO_SIDES = np.array([[SIDE, 0, 500], [0, SIDE, 375], [0, 0, 1]])


def fitted(pairs):
    inliers = [(x - [500, 375, 500, 375]) / SIDE for x in pairs.inliers]
    matches = Matches(inliers, np.zeros((len(inliers), 2), np.int64), np.array(pairs.photos), SIDE)
    priors = CameraPriors(np.ones(1), np.array([np.nan]))
    return fit_cameras(matches, TO_SIDES.T @ pairs.Fs @ TO_SIDES, [np.zeros((1, 5))], priors)


def test_standard_deviations_are_those_of_repeated_photos(shots):
    # 32 sets, each judged by the standard deviations it comes with
    scores = []
    for seed in range(32):
        made = shots(5, 40 + seed, k1=-0.1, center=(0.56, 0.46), points=90, noise_px=1.0)
        fit = fitted(made.pairs)
        theta = fit.state.thetas[0]
        said = camera_uncertainty(theta, covariance(fit, np.ones(1)), SIDE).spread
        found = calibration_from_parameters(theta, (1000, 750), "mine")
        errors = [*(found.K - made.Ks[0])[[0, 1, 0, 1], [0, 1, 2, 2]], found.radial + 0.1]
        scores.append(np.array(errors) / [said[name] for name in ("fx", "fy", "cx", "cy", "k1")])
    rms = np.sqrt(np.mean(np.square(scores), axis=0))
    assert np.all((rms > 0.55) & (rms < 1.6)), rms
    assert np.all(np.abs(np.mean(scores, axis=0)) < 0.6)


def test_spread_is_the_first_order_of_the_answer():
    theta = np.array([0.2, 0.03, -0.02, 0.1, -0.05])
    root = np.random.default_rng(0).normal(size=(5, 5)) * 1e-4
    said, correlations = camera_uncertainty(theta, root @ root.T, SIDE)
    drawn = theta + np.random.default_rng(1).normal(size=(4000, 5)) @ root.T
    answers = [calibration_from_parameters(one, (1000, 750), "mine") for one in drawn]
    values = np.array([[*a.K[[0, 1, 0, 1], [0, 1, 2, 2]], a.radial] for a in answers])
    assert list(said) == ["fx", "fy", "cx", "cy", "k1"]
    np.testing.assert_allclose(list(said.values()), values.std(axis=0), rtol=0.04)
    drawn_so = np.corrcoef(values.T)[np.triu_indices(5, 1)]
    assert list(correlations)[:2] == ["fx fy", "fx cx"] and np.ptp(drawn_so) > 0.5
    np.testing.assert_allclose(list(correlations.values()), drawn_so, atol=0.05)


def test_parameters_survive_the_answer():
    theta = np.array([0.2, 0.03, -0.02, 0.1, -0.05])
    for unit in (1000.0, 640.0):
        np.testing.assert_allclose(
            parameters_from_calibration(calibration_from_parameters(theta, (1000, 750), "mine", unit), unit), theta
        )


def test_more_matches_say_more(shots):
    spreads = []
    for count in (60, 240):
        fit = fitted(shots(5, 1, points=count).pairs)
        spreads.append(np.sqrt(covariance(fit, np.ones(1))[0, 0] - 1e-6))
    assert 1.4 < spreads[0] / spreads[1] < 3


def test_pairs_that_say_most_come_first(shots):
    made = shots(5, 1)
    few = [x[:20] if k == 3 else x for k, x in enumerate(made.pairs.inliers)]
    fit = fitted(type(made.pairs)(made.pairs.Fs, made.pairs.weights, made.pairs.size, made.pairs.photos, tuple(few)))
    order = key_pairs(fit, made.pairs.photos)
    assert set(order) <= set(made.pairs.photos)
    assert len(order) == len(set(order)) >= 7
    assert made.pairs.photos[3] not in order[:7]
    assert key_pairs(fit, ()) == ()


@pytest.mark.parametrize("seed", [3, 4])
def test_photos_that_disagree_widen_the_deviations(shots, seed):
    said = {}
    for name, focal in (("one", 1000.0), ("two", 1000 * np.exp(np.repeat([0.02, -0.02], 5)))):
        fit = fitted(shots(10, seed, focal=focal).pairs)
        said[name] = [np.sqrt(covariance(fit, np.ones(1), resampled=on)[0, 0]) for on in (False, True)]
    assert 1.0 <= said["one"][1] / said["one"][0] < 1.1
    assert 1.1 < said["two"][1] / said["two"][0] < 3
    assert 0.005 < said["two"][1] < 0.03  # the focals lie 0.02 about their mean


def test_few_photos_are_not_resampled(shots):
    assert np.all(jackknife_deviations(fitted(shots(5, 1).pairs)) == 0)
    assert np.all(jackknife_deviations(fitted(shots(8, 1).pairs))[:3] > 0)
