"""The loop apart from its parts: trial counts, stopping rules, what is handed to whom."""

from dataclasses import replace

import numpy as np
import pytest

import sfm_app.ransac.loop as loop
from sfm_app.ransac.loop import search
from sfm_app.ransac.mixture import mlesac
from sfm_app.ransac.points import prepare
from sfm_app.ransac.recipe import Recipe
from sfm_app.ransac.sampling import random_state
from sfm_app.ransac.scoring import msac, squared_distances
from sfm_app.ransac.search import Rules, next_better
from sfm_app.ransac.verification import OPEN, FullVerification, RandomisedTdd
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
    found = search(scene(outliers=0.8), options(max_trials=trials), 0, PLAIN)
    assert found is None or found.trials <= trials
    assert trials < 17 or found.trials == trials


def test_clean_matches_need_few_samples():
    pair = make_pair(PairOptions(points=300, sigma_px=0.01), 1)
    assert search(prepare(pair.x1, pair.x2, 0), options(), 0, PLAIN).trials < 10


def test_half_outliers_need_what_the_formula_says():
    # 3.19 with a share of 0.5 and confidence 0.9999 asks for 1174 samples; a model of 7 noisy points sees fewer inliers
    trials = [search(scene(0.5, seed), options(), seed, PLAIN).trials for seed in range(5)]
    assert 400 < np.median(trials) < 20000


def test_fewer_matches_than_a_sample():
    assert search(scene(points=8), options(), 0, PLAIN) is not None
    m = scene(points=8)
    assert search(replace(m, points=m.points[:6]), options(), 0, PLAIN) is None


def test_same_seed_same_bits_and_another_seed_other_samples():
    m = scene(0.4)
    first, again, other = (search(m, options(max_trials=50), seed, PLAIN) for seed in (1, 1, 2))
    assert first.F.tobytes() == again.F.tobytes()
    assert first.F.tobytes() != other.F.tobytes()


def test_converged_priors_end_the_search():
    flat = replace(PLAIN, validity=always(np.ones(300)), stop_on_convergence=True)
    patient = replace(flat, stop_on_convergence=False)
    m = scene(0.5)
    assert search(m, options(), 0, flat).trials < search(m, options(), 0, patient).trials


def test_patience_ends_the_search():
    m = scene(0.6)
    limited = search(m, options(), 0, replace(PLAIN, patience=5)).trials
    assert limited < search(m, options(), 0, PLAIN).trials


def test_priors_guide_the_samples():
    pair = make_pair(PairOptions(points=300, outliers=0.6), 3)
    m = prepare(pair.x1, pair.x2, 0)
    good = np.empty(300)
    good[m.rows] = pair.is_inlier
    told = replace(PLAIN, validity=always(good))

    guided, blind = (search(m, options(max_trials=150), 0, recipe) for recipe in (told, PLAIN))

    def support(found):
        return np.count_nonzero(squared_distances(m.points, found.F.reshape(9)) < (3 / m.unit_px) ** 2)

    assert support(guided) > support(blind) + 10


def test_local_optimisation_is_kept_only_if_better():
    m = scene(0.3)
    truth = search(m, options(), 5, PLAIN)
    told = replace(PLAIN, improve=always(truth.F))
    misled = replace(PLAIN, improve=always(np.eye(3)))

    assert search(m, options(), 0, told).trials <= search(m, options(), 0, PLAIN).trials
    assert search(m, options(), 0, misled).F.tobytes() == search(m, options(), 0, PLAIN).F.tobytes()


def test_next_better_leaves_the_best_alone_when_nothing_is_better():
    m, best = scene(), np.full(9, 7.0)
    drawn, score = next_better(
        m.points,
        np.cumsum(np.ones(300)),
        Rules(7, False, 0.0),
        msac(m.points, 0.01, None),
        OPEN,
        1e-12,
        25,
        random_state(0),
        best,
    )
    assert (drawn, score) == (25, 1e-12)
    assert (best == 7).all()


class Script:
    """In place of the inner loop: draws all it may, but after the given trials has a model of the given penalty."""

    def __init__(self, model, *better):
        self.model, self.better, self.trials, self.calls = model, list(better), 0, []

    def __call__(self, _points, _cumulative, rules, _measure, _gate, to_beat, limit, _state, best):
        self.calls.append((limit, rules.guided_share, to_beat))
        if self.better and self.better[0][0] <= self.trials + limit:
            at, score = self.better.pop(0)
            drawn, self.trials = at - self.trials, at
            best[:] = self.model
            return drawn, score
        self.trials += limit
        return limit, to_beat


@pytest.fixture
def scripted(monkeypatch):
    """Run a recipe on a scene whose true model the script hands out."""
    pair = make_pair(PairOptions(points=300, outliers=0.5, sigma_px=0.1), 0)
    m = prepare(pair.x1, pair.x2, 0)
    truth = search(m, options(), 0, PLAIN).F.reshape(9)

    def run(recipe, *better, model=truth, **values):
        script = Script(model, *better)
        monkeypatch.setattr(loop, "next_better", script)
        return search(m, options(**values), 0, recipe), script.calls

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

    def recover(points, F, threshold, measure, gate, state):
        seen.append((F.copy(), measure, gate))
        return seen[0][0] if len(seen) == 2 else wrong

    found, _ = scripted(replace(PLAIN, recover=recover), (1, 1e-9), max_trials=10)
    truth = seen[0][0]
    np.testing.assert_array_equal(found.F, truth)
    found, _ = scripted(replace(PLAIN, recover=recover), (1, 290.0), model=wrong.reshape(9), max_trials=10)
    np.testing.assert_allclose(found.F, truth, atol=1e-15)
    assert seen[1][2] is OPEN
    assert scripted(replace(PLAIN, recover=recover), max_trials=10)[0] is None
    assert len(seen) == 2


def test_patience_is_counted_from_the_last_better_model(scripted):
    found, calls = scripted(replace(PLAIN, patience=50), (30, 2.0), (70, 1.0))
    assert found.trials == 120
    assert [c[0] for c in calls] == [50, 50, 50]


def test_patience_without_a_credible_model_starts_again(scripted):
    nothing, calls = scripted(replace(PLAIN, patience=50), max_trials=170)
    assert nothing is None
    assert [c[0] for c in calls] == [50, 50, 50, 20]
    luck = np.ones(9) / 3
    assert scripted(replace(PLAIN, patience=50), (1, 1.0), model=luck, max_trials=170)[0].trials == 170


def test_first_priors_come_at_their_share_of_the_trials(scripted):
    seen = []

    def validity(_points, best, _threshold):
        seen.append(best.copy())
        return np.ones(300)

    recipe = replace(PLAIN, assumed_share=0.5, validity=validity, guided_after=0.1)
    _, calls = scripted(recipe, (10, 3.0), (60, 2.0), (200, 1.0), (300, 0.5))

    # a tenth of 1175 is 118: until then no priors, then those of the best model, then those of every new one
    assert [(c[0], c[1]) for c in calls] == [(118, 0), (108, 0), (58, 0), (1057, 1), (975, 1), (875, 1)]
    assert len(seen) == 3
    _, calls = scripted(recipe, (400, 3.0))
    assert [(c[0], c[1]) for c in calls] == [(118, 0), (1057, 0), (775, 1)]


def test_a_renewed_measure_scores_the_best_model_anew(scripted):
    # the script says 1e6; what the next models have to beat is counted with the share of inliers that the best one has
    _, calls = scripted(replace(PLAIN, score=mlesac, assumed_share=0.5), (10, 1e6))
    assert calls[0][2] == np.inf
    assert 500 < calls[1][2] < 1200


def test_tests_are_reviewed_and_told_of_every_trial_and_model(scripted):
    told = []

    class Nosy(FullVerification):
        review = 40

        def learn(self, trials):
            told.append(trials)

        def expect(self, share):
            told.append(round(share, 1))

    scripted(replace(PLAIN, verifier=Nosy), (50, 1.0), max_trials=100)
    assert told == [40, 10, 0.5, 40, 10]


def test_an_outlier_in_front_does_not_spoil_a_randomised_test():
    pair = make_pair(PairOptions(points=300, outliers=0.3, sigma_px=0.1), 2)
    m = prepare(pair.x1, pair.x2, 0)
    inlier = np.empty(300, dtype=bool)
    inlier[m.rows] = pair.is_inlier
    spoilt = replace(m, points=np.asfortranarray(m.points[np.argsort(inlier)]))  # all outliers come first

    found = search(spoilt, options(), 0, replace(PLAIN, verifier=RandomisedTdd))

    near = squared_distances(spoilt.points, found.F.reshape(9)) < (3 / m.unit_px) ** 2
    assert near[np.sort(inlier)].mean() > 0.9


def test_samples_of_eight_find_the_truth_too():
    m = scene(0.3)
    seven, eight = (search(m, options(), 0, replace(PLAIN, sample_size=n)) for n in (7, 8))
    near = [np.mean(squared_distances(m.points, h.F.reshape(9)) < (3 / m.unit_px) ** 2) for h in (seven, eight)]
    assert min(near) > 0.5
    assert eight.trials > seven.trials
    assert search(replace(m, points=m.points[:7].copy()), options(), 0, replace(PLAIN, sample_size=8)) is None
