"""The choice of the last fit: every one on every estimator, and each is best at what it is named after."""

import numpy as np
import pytest

from sfm_app.fundamental import ESTIMATORS
from sfm_app.fundamental.points import prepare
from sfm_app.fundamental.refits import REFITS, choose_refit, fit_eight_point
from sfm_app.geometry.epipolar import reprojection_distance, sampson_distance
from sfm_app.settings import EpipolarSettings
from sfm_app.synthetic.correspondences import PairOptions, make_pair
from sfm_app.types import EpipolarFit, Rejected

CHOICES = ["auto", "eight-point", "sampson", "reprojection"]
SCENE = PairOptions(points=300, sigma_px=0.7, outliers=0.3, width=1024, height=768, focal_px=900.0)


def options(refit):
    return EpipolarSettings(max_error_px=2.0, max_trials=2000, refit=refit)


def test_the_settings_offer_what_there_is():
    assert ["auto", *REFITS] == CHOICES
    for name in CHOICES:
        assert options(name).refit == name


@pytest.mark.parametrize("refit", CHOICES)
@pytest.mark.parametrize("estimator", ESTIMATORS)
def test_every_choice_works_on_every_estimator(estimator, refit):
    pair = make_pair(SCENE, 3)

    found = ESTIMATORS[estimator][0](pair.x1, pair.x2, options(refit), 0)

    assert isinstance(found, EpipolarFit), found
    assert np.linalg.svd(found.F, compute_uv=False)[2] < 1e-12
    assert 0.5 < np.sqrt(np.mean(sampson_distance(found.F, pair.x1, pair.x2)[pair.is_inlier] ** 2)) < 0.9
    assert 0 < np.median(sampson_distance(found.F, pair.exact_x1, pair.exact_x2)) < 0.4


@pytest.mark.parametrize("estimator", ESTIMATORS)
def test_the_choices_differ_and_are_close(estimator):
    pair = make_pair(SCENE, 3)
    found = [ESTIMATORS[estimator][0](pair.x1, pair.x2, options(refit), 0).F for refit in CHOICES]
    for k, F in enumerate(found[1:]):
        assert np.abs(F - found[k]).max() > 0
        assert np.median(sampson_distance(F, pair.exact_x1, pair.exact_x2)) < 0.4


@pytest.mark.parametrize("seed", range(5))
def test_each_is_best_at_its_own_distance_on_the_same_inliers(seed):
    pair = make_pair(PairOptions(points=200, sigma_px=2.0, outliers=0.2), seed)
    m = prepare(pair.x1, pair.x2, seed)
    good = np.empty(200)
    good[m.rows] = pair.is_inlier
    threshold, start = 6.0 / m.unit_px, fit_eight_point(m.points, good)
    inliers = m.points[sampson_distance(start, m.points[:, :2], m.points[:, 2:]) <= threshold]
    assert len(inliers) > 120

    fits = {name: refit(m.points, start, threshold) for name, refit in REFITS.items()}

    views = inliers[:, :2], inliers[:, 2:]
    for loss, best in ((sampson_distance, "sampson"), (reprojection_distance, "reprojection")):
        costs = {name: (loss(F, *views) ** 2).sum() for name, F in fits.items()}
        assert min(costs, key=costs.__getitem__) == best, costs


@pytest.mark.parametrize("name", REFITS)
def test_too_few_inliers_leave_the_model_alone(name):
    rng = np.random.default_rng(0)
    points, F = np.asfortranarray(rng.normal(size=(30, 4))), rng.normal(size=(3, 3))
    np.testing.assert_array_equal(REFITS[name](points, F, 1e-9), F)


def test_the_estimators_own_fit_comes_first():
    calls = []

    def own(points, F, threshold):
        calls.append(threshold)
        return F

    points, F = np.asfortranarray(np.random.default_rng(0).normal(size=(30, 4))), np.eye(3)
    assert choose_refit("auto", own) is own
    for name in REFITS:
        choose_refit(name, own)(points, F, 1.0)
    assert calls == [1.0] * 3


@pytest.mark.parametrize("refit", CHOICES)
@pytest.mark.parametrize("estimator", ESTIMATORS)
def test_a_plane_and_a_line_do_not_break_any(estimator, refit):
    rng = np.random.default_rng(1)
    x = rng.uniform(0, 1000, (100, 2))
    line = np.column_stack([np.linspace(0, 1000, 100), np.linspace(0, 700, 100)])
    for x1, x2 in ((x, 0.8 * x + 40), (line, line[:, ::-1].copy()), (x, x.copy())):
        found = ESTIMATORS[estimator][0](x1, x2, options(refit), 0)
        assert isinstance(found, Rejected) or found.degeneracy
