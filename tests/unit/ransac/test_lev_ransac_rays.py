"""Curved epipolar lines are no outliers where the lens is known."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sfm_app.camera.bearings import bearings, project
from sfm_app.fundamental.lev_ransac import fit_lev_ransac
from sfm_app.fundamental.rays import fit_lev_ransac_rays, validity
from sfm_app.geometry.epipolar import decompose_essential
from sfm_app.settings import EpipolarSettings
from sfm_app.types import Calibration, EpipolarFit, Rejected

K = np.array([[280.0, 0.0, 480.0], [0.0, 280.0, 320.0], [0.0, 0.0, 1.0]])
LENS = Calibration(K, 960, 640, "lens", True, projection="fisheye", fisheye=(0.0, 0.0, 0.0, 0.0))
SIZE = np.array([960.0, 640.0])
R = Rotation.from_euler("xyz", [5.0, -15.0, 4.0], degrees=True).as_matrix()
T = np.array([0.8, 0.2, 0.3])
OPTIONS = EpipolarSettings()


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
@pytest.mark.parametrize("wrong", [0, 150, 500])
def test_right_matches_are_told_from_wrong_ones(seed, wrong):
    x1, x2 = matches_of(seed, wrong=wrong)
    found = fit_lev_ransac_rays(lines_of(x1, x2), OPTIONS, seed)

    assert isinstance(found, EpipolarFit) and found.degeneracy == ""
    assert 0.93 < found.inliers[:200].mean() <= 1.0
    assert wrong == 0 or 0.0 < found.inliers[200:].mean() < 0.08
    assert 0.0 < turn_error_deg(found.F) < 1.0
    assert 0.2 < found.rms_px < 0.7


def test_pixels_lose_what_rays_keep():
    x1, x2 = matches_of(wrong=0)
    by_pixels = fit_lev_ransac(x1, x2, OPTIONS, 0)
    kept = by_pixels.inlier_count if isinstance(by_pixels, EpipolarFit) else 0
    assert kept < 140 and fit_lev_ransac_rays(lines_of(x1, x2), OPTIONS, 0).inlier_count > 190


def test_same_seed_same_result():
    lines = lines_of(*matches_of())
    first, second = (fit_lev_ransac_rays(lines, OPTIONS, 5) for _ in range(2))
    assert np.array_equal(first.F, second.F) and np.array_equal(first.inliers, second.inliers)


def test_a_turn_on_the_spot_is_named():
    found = fit_lev_ransac_rays(lines_of(*matches_of(wrong=0, t=np.zeros(3))), OPTIONS, 0)
    assert isinstance(found, EpipolarFit) and found.degeneracy == "rotation"


@pytest.mark.parametrize("count", [0, 5, 15, 300])
def test_wrong_matches_alone_are_rejected_with_a_reason(count):
    rng = np.random.default_rng(count)
    found = fit_lev_ransac_rays(lines_of(*(rng.uniform((0, 0), SIZE, (count, 2)) for _ in range(2))), OPTIONS, 0)
    assert isinstance(found, Rejected)
    few = count < OPTIONS.min_inliers
    assert found.reason in ({"too few matches"} if few else {"inliers no better than chance", "too few inliers"})


def test_equal_matches_count_once():
    x1, x2 = matches_of(right=10, wrong=0)
    assert fit_lev_ransac_rays(lines_of(np.tile(x1, (5, 1)), np.tile(x2, (5, 1))), OPTIONS, 0) == Rejected(
        "too few matches"
    )


def test_priors_tell_how_far_matches_move_the_fit():
    x1, x2 = matches_of(wrong=50)
    lines = lines_of(x1, x2)
    chances = validity(lines, fit_lev_ransac_rays(lines, OPTIONS, 0).F, OPTIONS.max_error_px)
    assert chances.max() == 1.0 and chances.min() >= 0.0
    assert np.median(chances[:200]) > 0.5 > np.mean(chances[200:])
