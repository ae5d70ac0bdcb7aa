"""Algorithm 3 and its error discrepancy."""

import numpy as np
import pytest

from sfm_app.selfcal.thesis.huang_faugeras import calibrate as calibrate_without_weights
from sfm_app.selfcal.thesis.perturbation import METHOD, calibrate, discrepancy_weights, error_discrepancies
from sfm_app.settings import CalibrationSettings
from sfm_app.types import CameraPairs

OPTIONS = CalibrationSettings()


def run(Fs, size=(1000, 750)):
    return calibrate(CameraPairs.from_Fs(Fs, size), OPTIONS, 0)


def test_an_error_of_k_alone_stays_within_the_bound(views):
    # (5.21) with exact F's: for an error of any size; -error leads from the estimate back to the truth
    made, rng = views(6, noise=0.0), np.random.default_rng(0)
    for size in (1.0, 100.0, 500.0):
        error = np.array([[1, 0, 1], [0, 1, 1], [0, 0, 0]]) * rng.normal(0, size, (3, 3))
        found = error_discrepancies(made.Fs, made.K + error, -error)
        assert 1e-4 < found.max() <= 1


def test_a_noisy_pair_stands_out(views):
    made = views(6, noise=0.0)
    noisy = made.Fs.copy()
    noisy[3] = views(6, noise=0.1).Fs[3]
    change = np.diag([10.0, 10.0, 0.0])
    discrepancies = error_discrepancies(noisy, made.K + change, change)
    assert np.argmax(discrepancies) == 3
    assert discrepancies[3] > 10 * np.median(discrepancies)
    weights = discrepancy_weights(discrepancies)
    assert weights[3] < 0.05 < np.median(weights)


def test_scale_of_f_and_unit_of_k_have_no_effect(views):
    made = views(4, noise=0.01)
    change = np.array([[30.0, 0, 5], [0, 20, -8], [0, 0, 0]])
    expected = error_discrepancies(made.Fs, made.K, change)
    unit = np.diag([1000.0, 1000.0, 1.0])
    in_widths = error_discrepancies(-7 * unit @ made.Fs @ unit, np.linalg.inv(unit) @ made.K, change / 1000)
    np.testing.assert_allclose(in_widths, expected, rtol=1e-9)


def test_weights_fall_with_the_discrepancy():
    weights = discrepancy_weights(np.array([2.0, 1.0, 3.0, 1e9]))
    scale = 1.4826 * 1.0  # deviations from the median 2.5: 0.5, 1.5, 0.5, huge
    np.testing.assert_allclose(weights[:3], np.exp(-np.array([1.0, 0.0, 2.0]) / scale))
    assert weights[3] == 0


def test_discrepancies_that_do_not_scatter_leave_equal_weights():
    np.testing.assert_array_equal(discrepancy_weights(np.array([4.0, 4.0, 4.0, 9.0])), np.ones(4))


def test_it_outdoes_equal_weights_where_pairs_are_wrong(views, random_fundamentals):
    errors = {calibrate: [], calibrate_without_weights: []}
    for seed in range(4):
        made = views(6, seed, noise=3e-4)
        Fs = made.Fs.copy()
        Fs[[2, 9]] = random_fundamentals(2, seed)
        for method, found in errors.items():
            evidence = method(CameraPairs.from_Fs(Fs, made.size), OPTIONS, 0).evidence
            found.append(abs(evidence["fx_px"] - 1000) + abs(evidence["fy_px"] - 1000))
    assert np.median(errors[calibrate]) < 0.2 * np.median(errors[calibrate_without_weights])


def test_good_pairs_keep_their_say(views):
    made = views(6, noise=5e-4)
    found = run(made.Fs)
    assert (found.identifiable, found.method) == (True, METHOD), found.reason
    assert 0 < np.abs(found.K - made.K).max() < 30
    assert 2 <= found.evidence["iterations"] <= 4
    assert 3 < found.evidence["weighted_pairs"] <= 15


def test_exact_pairs_end_it_early(views):
    made = views(5, noise=0.0)
    found = run(made.Fs)
    assert found.evidence["iterations"] < 4
    assert pytest.approx(made.K, abs=0.5) == found.K
