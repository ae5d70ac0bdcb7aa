"""The best model: one score, or two that are kept apart."""

import math
from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from sfm_app.fundamental.loop import GUIDED, UNGUIDED, BestModel, Recipe
from sfm_app.fundamental.points import prepare
from sfm_app.fundamental.pretests import NO_PRETEST
from sfm_app.fundamental.scores import geman_mcclure, msac, penalty, ransac, squared_distances
from sfm_app.synthetic.correspondences import PairOptions, make_pair

PAIR = make_pair(PairOptions(points=300, outliers=0.3, sigma_px=0.5), 1)
MATCHES = prepare(PAIR.x1, PAIR.x2, 0)
POINTS, THRESHOLD = MATCHES.points, 2.0 / MATCHES.unit_px


def in_frame(F):
    to1, to2 = (
        np.array([[MATCHES.unit_px, 0, x], [0, MATCHES.unit_px, y], [0, 0, 1]])
        for x, y in (MATCHES.center[:2], MATCHES.center[2:])
    )
    F = to2.T @ F @ to1
    return F / np.linalg.norm(F)


GOOD = in_frame(PAIR.F)
ROUGH = GOOD + 0.01 * np.random.default_rng(0).normal(size=(3, 3))
ROUGH /= np.linalg.norm(ROUGH)
BAD = np.diag([1.0, -1.0, 0.0]) / math.sqrt(2)

ONE = Recipe(score=msac, finish=lambda _points, F, _threshold: F)
TWO = replace(ONE, score=partial(geman_mcclure, scale=0.5), fine_score=partial(geman_mcclure, scale=0.1))


def score_of(F, score):
    return penalty(POINTS, 0, F.reshape(9), score(POINTS, THRESHOLD, None), math.inf, NO_PRETEST)


def best_of(recipe):
    return BestModel(POINTS, THRESHOLD, recipe)


def meet(best, F, score, kind=GUIDED):
    """What the loop does once a sample of that kind has given a better model."""
    best.samples[kind], best.to_beat[kind] = F.reshape(9), score_of(F, score)
    return best.update(kind)


def test_there_is_none_at_first():
    best = best_of(ONE)
    assert not best
    assert best.to_beat.tolist() == [math.inf, math.inf]


def test_one_score_is_the_one_to_beat():
    best = best_of(ONE)
    assert meet(best, ROUGH, msac)
    assert best
    assert best.to_beat.tolist() == [score_of(ROUGH, msac)] * 2
    np.testing.assert_array_equal(best.f, ROUGH.reshape(9))
    assert best.inlier_share() == np.mean(squared_distances(POINTS, ROUGH.reshape(9)) <= THRESHOLD**2)

    assert best.replace_if_better(7.0 * GOOD)
    np.testing.assert_allclose(best.f, GOOD.reshape(9), atol=1e-15)
    assert not best.replace_if_better(ROUGH)


@pytest.mark.parametrize(("improved", "kept"), [(GOOD, GOOD), (BAD, ROUGH)])
def test_with_one_score_an_improvement_is_kept_only_if_it_is_one(improved, kept):
    best = best_of(replace(ONE, improve=lambda *_: 3.0 * improved))

    assert meet(best, ROUGH, msac)

    np.testing.assert_allclose(best.f, kept.reshape(9), atol=1e-15)
    np.testing.assert_allclose(best.to_beat, score_of(kept, msac), rtol=1e-12)


def test_with_two_scores_samples_compete_with_samples_and_improved_models_with_each_other():
    answers = iter([GOOD, BAD, ROUGH])
    best = best_of(replace(TWO, improve=lambda *_: next(answers)))

    assert meet(best, BAD, TWO.score)  # a bad sample, improved to the truth
    assert best.to_beat[0] == score_of(BAD, TWO.score) > score_of(GOOD, TWO.score)
    np.testing.assert_allclose(best.f, GOOD.reshape(9), atol=1e-15)

    assert not meet(best, ROUGH, TWO.score)  # a better sample, whose improvement is worse
    assert best.to_beat[0] == score_of(ROUGH, TWO.score)
    np.testing.assert_allclose(best.f, GOOD.reshape(9), atol=1e-15)

    assert not best.replace_if_better(ROUGH)
    assert best.to_beat[0] == score_of(ROUGH, TWO.score)


def test_a_model_of_the_rest_needs_half_the_support_of_the_best_sample_once_the_rest_is_another():
    answers = iter([BAD, ROUGH, GOOD])
    best = best_of(replace(TWO, improve=lambda *_: next(answers)))
    nothing = len(POINTS) * best.loss.worst

    assert meet(best, ROUGH, TWO.score)
    assert nothing - best.to_beat[1] == pytest.approx((nothing - score_of(ROUGH, TWO.score)) / 2)
    assert meet(best, BAD, TWO.score, kind=UNGUIDED)  # its improvement wins; samples of all matches have their own bar
    assert best.to_beat[0] == score_of(ROUGH, TWO.score)
    np.testing.assert_allclose(best.f, ROUGH.reshape(9), atol=1e-15)
    assert nothing - best.to_beat[1] == pytest.approx((nothing - score_of(ROUGH, TWO.score)) / 2)
    assert meet(best, GOOD, TWO.score, kind=UNGUIDED)
    np.testing.assert_allclose(best.f, GOOD.reshape(9), atol=1e-15)


def test_the_finer_score_decides_between_improved_models():
    # many matches at 0.4 thresholds, or fewer at 0: a coarse scale takes the first, a fine one the second
    flat = np.zeros((100, 4))
    flat[:, 0], flat[:, 2] = np.arange(100), np.arange(100) + 5.0
    flat[60:, 3] = 0.4 * math.sqrt(2)
    shift = np.array([0, 0, 0, 0, 0, -1, 0, 1, 0.0]) / math.sqrt(2)
    middle = shift + np.array([0, 0, 0, 0, 0, 0, 0, 0, 0.2])
    coarse, fine = partial(geman_mcclure, scale=1.0), partial(geman_mcclure, scale=0.05)
    points, won = np.asfortranarray(flat), {}
    for scores in ((coarse, fine), (fine, coarse), (fine, fine)):
        best = BestModel(points, 1.0, replace(ONE, score=scores[0], fine_score=scores[1]))
        best.samples[0], best.to_beat[0] = middle / np.linalg.norm(middle), 50.0
        best.update(GUIDED)
        won[scores] = best.replace_if_better(shift.reshape(3, 3))
    assert won == {(coarse, fine): True, (fine, coarse): False, (fine, fine): True}


def test_a_score_that_changes_with_the_best_model_is_taken_anew():
    seen = []

    def moody(points, threshold, best):
        seen.append(best)
        return (ransac if best is None else msac)(points, threshold, best)

    best = best_of(replace(ONE, score=moody))
    meet(best, ROUGH, ransac)
    assert len(seen) == 2
    assert seen[0] is None
    assert best.loss == msac(POINTS, THRESHOLD, None)
    assert best.to_beat.tolist() == [score_of(ROUGH, msac)] * 2
