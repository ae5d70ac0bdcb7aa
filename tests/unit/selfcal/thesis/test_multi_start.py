"""Algorithm 2."""

from itertools import pairwise

import numpy as np
import pytest

from sfm_app.selfcal.pairs import prepare
from sfm_app.selfcal.thesis.multi_start import (
    METHOD,
    MOST_STARTS,
    USUAL_FOCAL,
    calibrate,
    focal_distribution,
    number_of_starts,
)
from sfm_app.settings import CalibrationSettings
from sfm_app.types import CameraPairs

OPTIONS = CalibrationSettings()


def run(Fs, size=(1000, 750), seed=0):
    return calibrate(CameraPairs.from_Fs(Fs, size), OPTIONS, seed)


@pytest.mark.parametrize(("pairs", "starts"), [(3, 1), (4, 11), (10, 358), (21, 3983), (45, MOST_STARTS)])
def test_as_many_starts_as_draw_any_triple_with_95_percent(pairs, starts):
    assert number_of_starts(pairs) == starts


def test_more_pairs_mean_no_fewer_starts():
    counts = [number_of_starts(pairs) for pairs in range(3, 60)]
    assert all(a <= b for a, b in pairwise(counts))


def test_focals_are_drawn_around_what_the_pairs_say(views):
    made = views(6, noise=1e-3, focal=1300)
    pairs = prepare(CameraPairs.from_Fs(made.Fs, made.size), unit_px=1000.0, origin_px=(0.0, 0.0))
    mean, deviation = focal_distribution(pairs, 0.75)
    assert 0 < abs(mean - 1.3) < 0.2
    assert 0.001 < deviation < 0.5


def test_pairs_that_say_nothing_leave_the_usual_focal(views):
    made = views(4, noise=0.0, motion=views.translation)
    pairs = prepare(CameraPairs.from_Fs(made.Fs, made.size), unit_px=1000.0, origin_px=(0.0, 0.0))
    assert focal_distribution(pairs, 0.75) == USUAL_FOCAL


def test_three_wrong_pairs_of_ten_do_no_harm(views, random_fundamentals):
    made = views(5, seed=2, noise=3e-4, aspect=1.1)
    Fs = made.Fs.copy()
    Fs[[0, 4, 7]] = random_fundamentals(3)
    found = run(Fs)
    assert (found.identifiable, found.method) == (True, METHOD), found.reason
    assert 0 < np.abs(found.K - made.K).max() < 60
    assert found.evidence["starts"] == 358


def test_three_pairs_that_happen_to_agree_are_no_camera(random_fundamentals):
    for seed in range(5):
        found = run(random_fundamentals(15, seed))
        assert not found.identifiable
        assert found.evidence["lead"] > -1


def test_the_three_pairs_of_three_photos_have_an_answer_but_no_confirmation(views):
    found = run(views(3, noise=1e-4).Fs)
    assert found.evidence["starts"] == 1
    assert "no others" in found.reason
    assert found.evidence["fx_px"] == pytest.approx(1000, rel=0.1)


def test_the_seed_decides(views):
    made = views(5, noise=2e-3)
    np.testing.assert_array_equal(run(made.Fs, seed=1).K, run(made.Fs, seed=1).K)
    answers = {run(made.Fs, seed=seed).evidence["fx_px"] for seed in range(3)}
    assert len(answers) > 1


def test_the_order_of_the_pairs_has_no_effect(views):
    made = views(5, noise=2e-3)
    shuffled = np.random.default_rng(0).permutation(10)
    np.testing.assert_allclose(run(made.Fs[shuffled]).K, run(made.Fs).K, rtol=1e-5)
