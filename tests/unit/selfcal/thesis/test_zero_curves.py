"""Algorithm 4 to the letter."""

import numpy as np
import pytest

from sfm_app.selfcal.thesis.zero_curves import METHOD, calibrate
from sfm_app.settings import CalibrationSettings
from sfm_app.types import CameraPairs

OPTIONS = CalibrationSettings()


def run(made, options=OPTIONS, seed=0):
    return calibrate(CameraPairs.from_Fs(made.Fs, made.size, made.weights), options, seed)


@pytest.mark.parametrize("aspect", [0.8, 1.0, 1.2])
@pytest.mark.parametrize("seed", range(3))
def test_finds_the_camera_to_a_sample_of_the_sweep(views, aspect, seed):
    made = views(5, seed, noise=5e-4, aspect=aspect)

    found = run(made)

    assert found.identifiable, found.reason
    assert found.method == METHOD
    assert 0 < abs(found.K[0, 0] - made.K[0, 0]) < 61  # samples are 30 px apart
    assert abs(found.K[1, 1] - made.K[1, 1]) < 61
    assert np.abs(found.K[:2, 2] - made.K[:2, 2]).max() < 50
    assert 0.8 < found.evidence["focal_support"] < 1
    assert found.evidence["focal_curves"] <= found.evidence["pairs"] == 10


def test_focal_and_center_in_x_are_samples_of_the_sweep(views):
    found = run(views(5), OPTIONS.model_copy(update={"samples": 50}))
    assert found.K[0, 0] / 60 == pytest.approx(round(found.K[0, 0] / 60))
    assert found.K[0, 2] / 20 == pytest.approx(round(found.K[0, 2] / 20))


def test_two_cameras_are_told_by_their_peaks(views):
    fine = OPTIONS.model_copy(update={"samples": 200})
    one = run(views(5, 2, noise=5e-4, focal=1100), fine)
    pairs = [views(5, 1 + 100 * i, noise=5e-4, focal=focal) for i, focal in enumerate((700, 1500))]
    Fs = np.concatenate([made.Fs for made in pairs])
    several = calibrate(CameraPairs.from_Fs(Fs, pairs[0].size), fine, 0)

    assert one.evidence["focal_peaks"] == 1
    assert several.evidence["focal_peaks"] >= 2


def test_outlying_curves_are_outvoted(views, random_fundamentals):
    made = views(6, noise=3e-4)
    Fs = made.Fs.copy()
    Fs[:3] = random_fundamentals(3)
    found = calibrate(CameraPairs.from_Fs(Fs, made.size, made.weights), OPTIONS, 0)
    assert found.identifiable
    assert found.K[0, 0] == pytest.approx(1000, rel=0.07)
    assert found.K[1, 1] == pytest.approx(1000, rel=0.07)


def test_level_cameras_leave_no_curve(views):
    found = run(views(5, motion=views.level, noise=0.0))
    assert not found.identifiable
    assert "usable focal curve" in found.reason


def test_an_answer_that_the_pairs_contradict_is_not_given(views):
    # the center is far from the middle, which the focal curves take it to be in
    found = run(views(5, center=(850, 150)))
    assert not found.identifiable
    assert "the pairs" in found.reason
    assert {"fx_px", "fy_px", "cx_px", "cy_px"} <= set(found.evidence)
    assert found.K[0, 0] == 1200


def test_a_seed_has_no_effect(views):
    made = views(4)
    np.testing.assert_array_equal(run(made, seed=1).K, run(made, seed=2).K)
