"""The verdict that all literal methods share."""

import numpy as np
import pytest

from sfm_app.selfcal.thesis.verdict import CameraParameters, calibrate_with
from sfm_app.types import CameraPairs


def judged(made, answer):
    return calibrate_with("mine", CameraPairs.from_Fs(made.Fs, made.size), lambda *_: answer)


def camera_of(made, factor=1.0):
    K = made.K / made.size[0]
    return CameraParameters(factor * K[0, 0], factor * K[1, 1], K[0, 2], K[1, 2])


def test_a_camera_that_the_pairs_support_is_known(views):
    made = views(5, aspect=1.1, center=(520, 350))
    found = judged(made, camera_of(made))
    assert (found.identifiable, found.method, found.reason) == (True, "mine", "")
    np.testing.assert_allclose(found.K, made.K)
    assert 0.9 < found.evidence["support"] < 1
    assert found.evidence["lead"] > 1


@pytest.mark.parametrize("factor", [0.6, 1.4])
def test_a_wrong_one_is_not_but_the_evidence_keeps_it(views, factor):
    made = views(5)
    found = judged(made, camera_of(made, factor))
    assert not found.identifiable
    assert "the pairs" in found.reason
    assert found.K[0, 0] == 1200
    names = ("fx_px", "fy_px", "cx_px", "cy_px")
    assert [found.evidence[name] for name in names] == pytest.approx([1000 * factor, 1000 * factor, 500, 375])


def test_any_camera_that_parallel_axes_fit_is_undecided(views):
    made = views(5, motion=views.translation)
    found = judged(made, camera_of(made))
    assert "other focals" in found.reason


@pytest.mark.parametrize(("sample", "known"), [(0, True), (3, False), (10, False), (12, False)])
def test_pairs_that_were_fitted_do_not_speak_for_the_answer(views, random_fundamentals, sample, known):
    Fs = np.concatenate([views(3).Fs, random_fundamentals(7)])
    found = calibrate_with(
        "mine", CameraPairs.from_Fs(Fs, (1000, 750)), lambda *_: CameraParameters(1.0, 1.0, 0.5, 0.375), sample
    )
    assert found.identifiable == known
    assert 0.2 < found.evidence["support"] < 0.4


def test_a_method_may_have_no_answer(views):
    found = judged(views(4), "no curve")
    assert (found.identifiable, found.reason, found.method) == (False, "no curve", "guess")


def test_two_pairs_are_too_few_to_ask(views):
    made = views(3)
    pairs = CameraPairs.from_Fs(made.Fs[:2], made.size)
    found = calibrate_with("mine", pairs, lambda *_: pytest.fail("asked"))
    assert found.reason == "2 usable pairs, 3 are needed"


def test_k_init_is_as_wide_as_the_image():
    np.testing.assert_array_equal(CameraParameters.initial(0.75).K, [[1, 0, 0.5], [0, 1, 0.375], [0, 0, 1]])
