"""Trial counts, stopping rules, and the best model."""

import math
from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from sfm_app.fundamental.loop import GUIDED, UNGUIDED, BestModel, Recipe, SamplingPlan, draw_until_better, run_loop
from sfm_app.fundamental.points import prepare
from sfm_app.fundamental.pretests import NO_PRETEST, FullScoring, RandomizedTdd
from sfm_app.fundamental.samples import random_state
from sfm_app.fundamental.scores import geman_mcclure, mlesac, msac, penalty, ransac, squared_distances
from sfm_app.settings import EpipolarSettings
from sfm_app.synthetic.correspondences import PairOptions, make_pair


def always(value):
    """A part of a recipe that answers every call with the same."""
    return lambda *_: value


PLAIN = Recipe(score=msac, finish=lambda _points, F, _threshold: F)


def scene(outliers=0.3, seed=0, points=300):
    pair = make_pair(PairOptions(points=points, outliers=outliers), seed)
    return prepare(pair.x1, pair.x2, seed)


def options(**values):
    return EpipolarSettings(max_error_px=3.0, **values)


@pytest.mark.parametrize("trials", [1, 2, 17])
def test_no_more_samples_than_allowed(trials):
    found = run_loop(scene(outliers=0.8), options(max_trials=trials), 0, PLAIN)
    assert found is None or found.trials <= trials
    assert trials < 17 or found.trials == trials


def test_half_outliers_need_what_the_formula_says():
    # 3.19 with a share of 0.5 and confidence 0.9999 asks for 1174 samples; a model of 7 noisy points sees fewer inliers
    trials = [run_loop(scene(0.5, seed), options(), seed, PLAIN).trials for seed in range(5)]
    assert 400 < np.median(trials) < 20000


def test_fewer_matches_than_a_sample():
    assert run_loop(scene(points=8), options(), 0, PLAIN) is not None
    m = scene(points=8)
    assert run_loop(replace(m, points=m.points[:6]), options(), 0, PLAIN) is None


def test_converged_priors_end_the_search():
    flat = replace(PLAIN, validity=always(np.ones(300)), stop_on_convergence=True)
    patient = replace(flat, stop_on_convergence=False)
    m = scene(0.5)
    assert run_loop(m, options(), 0, flat).trials < run_loop(m, options(), 0, patient).trials


def test_priors_guide_the_samples():
    pair = make_pair(PairOptions(points=300, outliers=0.6), 3)
    m = prepare(pair.x1, pair.x2, 0)
    good = np.empty(300)
    good[m.rows] = pair.is_inlier
    told = replace(PLAIN, validity=always(good))

    guided, blind = (run_loop(m, options(max_trials=150), 0, recipe) for recipe in (told, PLAIN))

    def support(found):
        return np.count_nonzero(squared_distances(m.points, found.F.reshape(9)) < (3 / m.unit_px) ** 2)

    assert support(guided) > support(blind) + 10


def test_local_optimization_is_kept_only_if_better():
    m = scene(0.3)
    truth = run_loop(m, options(), 5, PLAIN)
    told = replace(PLAIN, improve=always(truth.F))
    misled = replace(PLAIN, improve=always(np.eye(3)))
    assert run_loop(m, options(), 0, told).trials <= run_loop(m, options(), 0, PLAIN).trials
    assert run_loop(m, options(), 0, misled).F.tobytes() == run_loop(m, options(), 0, PLAIN).F.tobytes()


def draw(points, draws, to_beat, best, limit=25, pretests=(NO_PRETEST, NO_PRETEST), seed=0):
    return draw_until_better(
        points, draws, msac(points, 0.01, None), pretests, to_beat, limit, random_state(seed), best
    )


def blind(count, batch=1):
    """Uniform samples only."""
    return SamplingPlan(7, False, batch, 0.0, np.cumsum(np.ones(count)), 0.0, np.zeros(1))


def test_next_better_leaves_the_best_alone_when_nothing_is_better():
    m, best, to_beat = scene(), np.full((2, 9), 7.0), np.full(2, 1e-12)
    assert draw(m.points, blind(300), to_beat, best) == 25
    assert (best == 7).all()
    assert (to_beat == 1e-12).all()


@pytest.mark.parametrize(("batch", "limit", "drawn"), [(1, 25, 1), (4, 25, 4), (32, 100, 32), (32, 20, 20)])
def test_a_batch_is_drawn_to_its_end_and_its_best_model_returned(batch, limit, drawn):
    m, best, to_beat = scene(), np.zeros((2, 9)), np.full(2, np.inf)
    assert draw(m.points, blind(300, batch), to_beat, best, limit) == drawn
    one_by_one, lowest, state = np.zeros((2, 9)), np.full(2, np.inf), random_state(0)
    left = drawn
    while left:
        left -= draw_until_better(
            m.points, blind(300), msac(m.points, 0.01, None), (NO_PRETEST, NO_PRETEST), lowest, left, state, one_by_one
        )
    np.testing.assert_array_equal(best, one_by_one)
    np.testing.assert_array_equal(to_beat, lowest)


def test_samples_besides_the_priors_compete_with_each_other_only():
    pair = make_pair(PairOptions(points=300, outliers=0.5, sigma_px=0.0), 3)
    points = prepare(pair.x1, pair.x2, 0)
    rest = np.zeros(300)
    rest[points.rows[pair.is_inlier]] = 1.0
    draws = blind(300)._replace(rest_share=1.0, rest=np.cumsum(rest), guided_share=1e-9)
    best, to_beat = np.zeros((2, 9)), np.array([1e-12, np.inf])  # no sample of all matches can win

    assert draw(points.points, draws, to_beat, best) < 25

    assert (best[0] == 0).all()
    assert to_beat[0] == 1e-12
    exact = squared_distances(points.points, best[1])[rest > 0]
    assert np.median(exact) < 1e-12
    # fewer matches than a sample are no rest: uniform samples take their place, and their kind once there are priors
    few = draws._replace(rest=np.cumsum(np.arange(300) < 6).astype(np.float64))
    for guided_share, kind in ((1e-9, 1), (0.0, 0)):
        best, to_beat = np.zeros((2, 9)), np.full(2, np.inf)
        draw(points.points, few._replace(guided_share=guided_share), to_beat, best)
        assert to_beat[kind] < np.inf == to_beat[1 - kind]


class Script:
    """In place of the inner loop: draws all it may, but after the given trials has a model of the given penalty."""

    def __init__(self, model, *better):
        self.model, self.better, self.trials, self.calls = model, list(better), 0, []

    def __call__(self, _points, draws, _measure, _gates, to_beat, limit, _state, best):
        self.calls.append((limit, draws.guided_share, to_beat[0]))
        if self.better and self.better[0][0] <= self.trials + limit:
            at, score = self.better.pop(0)
            drawn, self.trials = at - self.trials, at
            best[0], to_beat[0] = self.model, score
            return drawn
        self.trials += limit
        return limit


@pytest.fixture
def scripted():
    """Run a recipe on a scene whose true model the script hands out."""
    pair = make_pair(PairOptions(points=300, outliers=0.5, sigma_px=0.1), 0)
    m = prepare(pair.x1, pair.x2, 0)
    truth = run_loop(m, options(), 0, PLAIN).F.reshape(9)

    def run(recipe, *better, model=truth, **values):
        script = Script(model, *better)
        return run_loop(m, options(**values), 0, recipe, script), script.calls

    return run


def test_a_search_ends_when_319_says_so(scripted):
    found, calls = scripted(PLAIN, (10, 1.0))
    seen = np.log(1 - options().confidence) / np.log1p(-(0.5**7))
    assert found.trials == pytest.approx(seen, rel=0.25)  # a few outliers lie on their lines
    assert [c[0] for c in calls] == [20000, found.trials - 10]


def test_assumed_shares_fix_the_trials(scripted):
    fixed = replace(PLAIN, assumed_share=0.5)
    assert scripted(fixed, (10, 1.0))[0].trials == 1175
    assert scripted(fixed, (10, 1.0), max_trials=100)[0].trials == 100
    assert scripted(replace(fixed, sample_size=8), (10, 1.0))[0].trials == 2354


def test_least_trials_are_drawn_even_if_fewer_would_do(scripted):
    eager = replace(PLAIN, assumed_share=0.9)  # 3.19 asks for 15
    assert scripted(eager, (3, 1.0))[0].trials == 15
    found, calls = scripted(replace(eager, least_trials=40), (3, 2.0), (30, 1.0))
    assert found.trials == 40
    assert [c[0] for c in calls] == [40, 37, 10]
    assert scripted(replace(eager, least_trials=40), (3, 1.0), max_trials=25)[0].trials == 25
    assert scripted(replace(PLAIN, assumed_share=0.5, least_trials=40), (3, 1.0))[0].trials == 1175


def test_a_last_attempt_may_beat_the_best_model_and_else_is_dropped(scripted):
    seen, wrong = [], np.eye(3) / np.sqrt(3)

    def recover(points, F, threshold, loss, state):
        seen.append((F.copy(), loss))
        return seen[0][0] if len(seen) == 2 else wrong

    found, _ = scripted(replace(PLAIN, recover=recover), (1, 1e-9), max_trials=10)
    truth = seen[0][0]
    np.testing.assert_array_equal(found.F, truth)
    found, _ = scripted(replace(PLAIN, recover=recover), (1, 290.0), model=wrong.reshape(9), max_trials=10)
    np.testing.assert_allclose(found.F, truth, atol=1e-15)
    assert len(seen) == 3  # a better one is tried from again
    assert scripted(replace(PLAIN, recover=recover), max_trials=10)[0] is None
    assert len(seen) == 3


def test_patience_is_counted_from_the_last_better_model(scripted):
    found, calls = scripted(replace(PLAIN, patience=always(50), least_trials=50), (30, 2.0), (70, 1.0))
    assert found.trials == 120
    assert [c[0] for c in calls] == [50, 50, 50]


def test_patience_without_a_credible_model_goes_on(scripted):
    waiting = replace(PLAIN, patience=always(50), least_trials=50)
    nothing, calls = scripted(waiting, max_trials=170)
    assert nothing is None
    assert [c[0] for c in calls] == [50, 50, 50, 20]
    endless = replace(waiting, patience=always(np.inf))
    luck = np.ones(9) / 3
    assert scripted(endless, (1, 1.0), model=luck, max_trials=170)[0].trials == 170


def test_patience_is_asked_about_the_best_model_after_the_least_trials(scripted):
    asked = []

    def patience(points, F, threshold):
        asked.append(F.copy())
        return 70.0

    recipe = replace(PLAIN, patience=patience, least_trials=50)
    found, calls = scripted(recipe, (10, 2.0), (100, 1.0))
    # idle for 50 after the 10th: 20 more; the 100th comes too late
    assert found.trials == 80
    assert [c[0] for c in calls] == [50, 50, 20]
    np.testing.assert_array_equal(asked, [found.F, found.F])


@pytest.mark.parametrize(("improved", "asked"), [([0], [0]), ([1], [1]), ([0, 1], [0, 1]), ([], [])])
def test_only_kinds_of_samples_that_improved_are_asked(monkeypatch, improved, asked):
    seen, m = [], scene()

    def script(_points, _draws, _measure, _gates, to_beat, limit, _state, best):
        if not seen:
            best[improved], to_beat[improved] = np.ones(9) / 3, 1.0
        return limit

    def update(best, kind):
        seen.append(kind)
        assert best.samples[kind].any()
        best.to_beat[:] = 0.5  # as a new best model does: the bar of the other kind falls too
        return True

    monkeypatch.setattr(BestModel, "update", update)
    run_loop(m, options(max_trials=120), 0, replace(PLAIN, least_trials=50, patience=always(200)), script)
    assert seen == asked


def test_first_priors_come_at_their_share_of_the_trials(scripted):
    seen = []

    def validity(_points, best, _threshold):
        seen.append(best.copy())
        return np.ones(300)

    recipe = replace(PLAIN, assumed_share=0.5, validity=validity, warmup_share=0.1)
    _, calls = scripted(recipe, (10, 3.0), (60, 2.0), (200, 1.0), (300, 0.5))

    # a tenth of 1175 is 118: until then no priors, then those of the best model, then those of every new one
    assert [(c[0], c[1]) for c in calls] == [(118, 0), (108, 0), (58, 0), (1057, 1), (975, 1), (875, 1)]
    assert len(seen) == 3
    _, calls = scripted(recipe, (400, 3.0))
    assert [(c[0], c[1]) for c in calls] == [(118, 0), (1057, 0), (775, 1)]


def test_the_rest_are_matches_beyond_two_thresholds():
    m, rests = scene(0.3), []
    F = run_loop(m, options(), 0, PLAIN).F

    def draw(_points, draws, _loss, _pretests, to_beat, limit, _state, best):
        rests.append(draws.rest[-1])
        if len(rests) == 1:
            best[0], to_beat[0] = F.reshape(9), 1.0
        return limit

    recipe = replace(PLAIN, validity=always(np.ones(300)), rest_share=0.25, patience=always(100), least_trials=50)
    run_loop(m, options(max_trials=200), 0, recipe, draw)
    assert rests[:2] == [0.0, np.count_nonzero(squared_distances(m.points, F.reshape(9)) > (6 / m.unit_px) ** 2)]


def test_a_renewed_measure_scores_the_best_model_anew(scripted):
    # the script says 1e6; what the next models have to beat is counted with the share of inliers that the best one has
    _, calls = scripted(replace(PLAIN, score=mlesac, assumed_share=0.5), (10, 1e6))
    assert calls[0][2] == np.inf
    assert 500 < calls[1][2] < 1200


def test_tests_are_reviewed_and_told_of_every_trial_and_model(scripted):
    told = []

    class Nosy(FullScoring):
        review = 40

        def learn(self, trials):
            told.append(trials)

        def expect(self, share):
            told.append(round(share, 1))

    scripted(replace(PLAIN, pretest=Nosy), (50, 1.0), max_trials=100)
    assert told == [40, 10, 0.5, 40, 10]


def test_an_outlier_in_front_does_not_spoil_a_randomized_test():
    pair = make_pair(PairOptions(points=300, outliers=0.3, sigma_px=0.1), 2)
    m = prepare(pair.x1, pair.x2, 0)
    inlier = np.empty(300, dtype=bool)
    inlier[m.rows] = pair.is_inlier
    spoilt = replace(m, points=np.asfortranarray(m.points[np.argsort(inlier)]))  # all outliers come first
    found = run_loop(spoilt, options(), 0, replace(PLAIN, pretest=RandomizedTdd))
    near = squared_distances(spoilt.points, found.F.reshape(9)) < (3 / m.unit_px) ** 2
    assert near[np.sort(inlier)].mean() > 0.9


def test_samples_of_eight_find_the_truth_too():
    m = scene(0.3)
    seven, eight = (run_loop(m, options(), 0, replace(PLAIN, sample_size=n)) for n in (7, 8))
    near = [np.mean(squared_distances(m.points, h.F.reshape(9)) < (3 / m.unit_px) ** 2) for h in (seven, eight)]
    assert min(near) > 0.5
    assert eight.trials > seven.trials
    assert run_loop(replace(m, points=m.points[:7].copy()), options(), 0, replace(PLAIN, sample_size=8)) is None


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


def test_one_score_is_the_one_to_beat():
    best = best_of(ONE)
    assert not best and best.to_beat.tolist() == [math.inf, math.inf]
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
