"""The estimators as a whole: thesis, production, rays."""

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from benchmarks.synthetic.matches import make_two_motions
from sfm_app.camera.bearings import bearings, project
from sfm_app.fundamental.estimate import fit_by_recipe
from sfm_app.fundamental.lev_ransac import fit_lev_ransac, search_patience
from sfm_app.fundamental.loop import run_loop
from sfm_app.fundamental.points import prepare
from sfm_app.fundamental.rays import fit_lev_ransac_rays, validity
from sfm_app.fundamental.recipes import RECIPES, median_sigma
from sfm_app.geometry.epipolar import cross_matrix, decompose_essential, sampson_distance
from sfm_app.settings import EpipolarSettings
from sfm_app.synthetic.correspondences import PairOptions, make_pair
from sfm_app.types import Calibration, EpipolarFit, RayFit, Rejected
from tests.unit.fundamental.conftest import UNIT, plane_scene

OPTIONS = EpipolarSettings(max_error_px=1.96, max_trials=20_000)


def trials_of(name, outliers, seeds=range(5)):
    found = []
    for seed in seeds:
        pair = make_pair(PairOptions(points=600, outliers=outliers), seed)
        found.append(run_loop(prepare(pair.x1, pair.x2, seed), OPTIONS, seed, RECIPES[name][0]).trials)
    return np.array(found)


def test_tdd_needs_the_trials_that_its_test_costs():
    share = 1 - 0.3 - 0.08  # of a seven-point model: noise hides some inliers
    assert 1.1 < np.median(trials_of("ransac-tdd", 0.3)) / np.median(trials_of("ransac", 0.3)) < 1.8 / share


def test_sprt_costs_few_trials():
    assert 0.7 < np.median(trials_of("ransac-sprt", 0.4)) / np.median(trials_of("ransac", 0.4)) < 1.4


def test_guided_samples_save_trials_at_high_contamination():
    # thesis 4.8: LEV-RANSAC needs the fewest, RES-RANSAC comes between it and plain sampling
    plain, residuals, leverages = (trials_of(n, 0.5).mean() for n in ("mlesac", "res-ransac", "lev-ransac-thesis"))
    assert leverages < residuals / 3
    assert residuals < 0.8 * plain


def test_lmeds_draws_for_half_outliers_and_holds_up_to_there():
    expected = math.ceil(math.log(1 - OPTIONS.confidence) / math.log(1 - 0.5**7))
    assert (trials_of("lmeds", 0.1, range(2)) == expected).all()
    for seed in range(3):
        pair = make_pair(PairOptions(points=600, outliers=0.4), seed)
        fit = fit_by_recipe(pair.x1, pair.x2, OPTIONS, seed, RECIPES["lmeds"][0])
        assert sampson_distance(fit.F, pair.exact_x1, pair.exact_x2).mean() < 0.4


@pytest.mark.parametrize("scale", [0.1, 1.7])
def test_the_median_gives_the_scale_of_the_noise(scale):
    noise = np.random.default_rng(1).normal(scale=scale, size=20_000)
    assert median_sigma(noise**2) == pytest.approx(scale, rel=0.03)
    # few matches: seven of them are met exactly
    assert median_sigma(np.full(12, scale**2)) == pytest.approx(1.4826 * 2 * scale)
    assert median_sigma(np.zeros(3)) == 0


def test_the_still_scene_wins_over_an_object_that_moves():
    found = 0
    for seed in range(10):
        pair = make_two_motions(PairOptions(outliers=0.1), 0.3, seed).pair
        fit = fit_lev_ransac(pair.x1, pair.x2, EpipolarSettings(), seed)
        still = pair.is_inlier
        missed = sampson_distance(fit.F, pair.exact_x1[still], pair.exact_x2[still])
        found += bool(missed.mean() < 1.0)
    assert found >= 9


@pytest.mark.parametrize("seed", range(2))
def test_long_searches_give_the_same_bytes(seed):
    pair = make_pair(PairOptions(points=600, outliers=0.7, sigma_px=1.0), seed)
    settings = EpipolarSettings(max_error_px=2.0, max_trials=2000)
    fits = [fit_lev_ransac(pair.x1, pair.x2, settings, seed) for _ in range(3)]
    assert isinstance(fits[0], EpipolarFit)
    assert fits[0].trials > 300
    assert {(fit.F.tobytes(), fit.inliers.tobytes(), fit.priors.tobytes(), fit.trials) for fit in fits} == {
        (fits[0].F.tobytes(), fits[0].inliers.tobytes(), fits[0].priors.tobytes(), fits[0].trials)
    }


THRESHOLD = 1.5 / UNIT


@pytest.mark.parametrize("seed", range(5))
def test_a_scene_with_parallax_needs_little_patience(seed):
    points, _, F, _ = plane_scene(seed, on_plane=150, off_plane=250, outliers=200, sigma_px=0.3)
    assert 1 < search_patience(points, F, THRESHOLD) < 300


@pytest.mark.parametrize("seed", range(5))
def test_a_plane_with_a_wrong_epipole_needs_much(seed):
    points, H, F, _ = plane_scene(seed, on_plane=200, off_plane=60, outliers=200, sigma_px=0.3)
    epipole = np.append(np.random.default_rng(seed).uniform(-1, 1, 2), 1.0)
    wrong = cross_matrix(epipole) @ H
    long = search_patience(points, wrong / np.linalg.norm(wrong), THRESHOLD)
    assert long > 1000
    # the right epipole has all of the matches off the plane for it
    assert 1 < search_patience(points, F, THRESHOLD) < 0.6 * long


@pytest.mark.parametrize("seed", range(5))
def test_luck_is_waited_out_for_ever(seed):
    points, _, F, _ = plane_scene(seed, on_plane=0, off_plane=0, outliers=400, sigma_px=0.3)
    assert search_patience(points, F, THRESHOLD) == math.inf
    assert search_patience(points[:7].copy("F"), F, THRESHOLD) == math.inf


def test_patience_falls_as_matches_off_the_plane_come_in():
    waits = []
    for off_plane in (0, 60, 120, 240):
        points, _, F, _ = plane_scene(1, on_plane=200, off_plane=off_plane, outliers=100, sigma_px=0.3)
        waits.append(search_patience(points, F, THRESHOLD))
    assert waits == sorted(waits, reverse=True)
    assert waits[0] > 10 * waits[-1]


FISHEYE_K = np.array([[280.0, 0.0, 480.0], [0.0, 280.0, 320.0], [0.0, 0.0, 1.0]])
LENS = Calibration(FISHEYE_K, 960, 640, "lens", True, projection="fisheye", distortion=(0.0,))
SIZE = np.array([960.0, 640.0])
R = Rotation.from_euler("xyz", [5.0, -15.0, 4.0], degrees=True).as_matrix()
T = np.array([0.8, 0.2, 0.3])
DEFAULTS = EpipolarSettings()


def matches_of(seed=0, *, right=200, wrong=150, noise_px=0.5, t=T):
    rng = np.random.default_rng([seed, 3])
    X = rng.normal(size=(4 * right, 3)) * [4.0, 2.5, 2.0] + [0.0, 0.0, 3.0]
    x1, x2 = (project(Y, LENS) for Y in (X, X @ R.T + t))
    seen = ((x1 > 0) & (x1 < SIZE) & (x2 > 0) & (x2 < SIZE)).all(axis=1)
    x1, x2 = (x[seen][:right] + rng.normal(0.0, noise_px, (right, 2)) for x in (x1, x2))
    others = [rng.uniform((0, 0), SIZE, (wrong, 2)) for _ in range(2)]
    return np.vstack([x1, others[0]]), np.vstack([x2, others[1]])


def lines_of(x1, x2):
    return np.hstack([bearings(x1, LENS), bearings(x2, LENS)])


def turn_error_deg(E):
    return min(np.degrees(Rotation.from_matrix(R.T @ turn).magnitude()) for turn, _ in decompose_essential(E))


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("wrong", [0, 150, pytest.param(500, marks=pytest.mark.slow)])
def test_right_matches_are_told_from_wrong_ones(seed, wrong):
    x1, x2 = matches_of(seed, wrong=wrong)
    found = fit_lev_ransac_rays(lines_of(x1, x2), DEFAULTS, seed)
    assert isinstance(found, RayFit) and found.degeneracy == ""
    assert 0.93 < found.inliers[:200].mean() <= 1.0
    assert wrong == 0 or 0.0 < found.inliers[200:].mean() < 0.08
    assert 0.0 < turn_error_deg(found.E) < 1.0
    assert 0.2 < found.rms_px < 0.7


def test_pixels_lose_what_rays_keep():
    x1, x2 = matches_of(wrong=0)
    by_pixels = fit_lev_ransac(x1, x2, DEFAULTS, 0)
    kept = by_pixels.inlier_count if isinstance(by_pixels, EpipolarFit) else 0
    assert kept < 140 and fit_lev_ransac_rays(lines_of(x1, x2), DEFAULTS, 0).inlier_count > 190


def test_same_seed_same_result():
    lines = lines_of(*matches_of())
    first, second = (fit_lev_ransac_rays(lines, DEFAULTS, 5) for _ in range(2))
    assert np.array_equal(first.E, second.E) and np.array_equal(first.inliers, second.inliers)


def test_a_turn_on_the_spot_is_named():
    found = fit_lev_ransac_rays(lines_of(*matches_of(wrong=0, t=np.zeros(3))), DEFAULTS, 0)
    assert isinstance(found, RayFit) and found.degeneracy == "rotation"


@pytest.mark.parametrize("count", [0, 5, 15, 300])
def test_wrong_matches_alone_are_rejected_with_a_reason(count):
    rng = np.random.default_rng(count)
    found = fit_lev_ransac_rays(lines_of(*(rng.uniform((0, 0), SIZE, (count, 2)) for _ in range(2))), DEFAULTS, 0)
    assert isinstance(found, Rejected)
    few = count < DEFAULTS.min_inliers
    assert found.reason in ({"too few matches"} if few else {"inliers no better than chance", "too few inliers"})


def test_equal_matches_count_once():
    x1, x2 = matches_of(right=10, wrong=0)
    assert fit_lev_ransac_rays(lines_of(np.tile(x1, (5, 1)), np.tile(x2, (5, 1))), DEFAULTS, 0) == Rejected(
        "too few matches"
    )


def test_priors_tell_how_far_matches_move_the_fit():
    x1, x2 = matches_of(wrong=50)
    lines = lines_of(x1, x2)
    chances = validity(lines, fit_lev_ransac_rays(lines, DEFAULTS, 0).E, DEFAULTS.max_error_px)
    assert chances.max() == 1.0 and chances.min() >= 0.0
    assert np.median(chances[:200]) > 0.5 > np.mean(chances[200:])
