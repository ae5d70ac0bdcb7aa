"""The loop apart from its parts: trial counts, stopping rules, what is handed to whom."""

from dataclasses import replace

import numpy as np
import pytest

from sfm_app.ransac.loop import Recipe, search
from sfm_app.ransac.points import prepare
from sfm_app.ransac.sampling import random_state
from sfm_app.ransac.scoring import msac, squared_distances
from sfm_app.ransac.search import Rules, next_better
from sfm_app.ransac.verification import OPEN
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
