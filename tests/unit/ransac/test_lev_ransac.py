"""The production estimator as a whole: the dominant motion, and the same bytes every time."""

import pytest

from benchmarks.synthetic.matches import make_two_motions
from sfm_app.fundamental.lev_ransac import fit_lev_ransac
from sfm_app.geometry.epipolar import sampson_distance
from sfm_app.settings import EpipolarSettings
from sfm_app.synthetic.correspondences import PairOptions, make_pair
from sfm_app.types import EpipolarFit


def test_the_still_scene_wins_over_an_object_that_moves():
    found = 0
    for seed in range(10):
        pair = make_two_motions(PairOptions(outliers=0.1), 0.3, seed).pair
        fit = fit_lev_ransac(pair.x1, pair.x2, EpipolarSettings(), seed)
        still = pair.is_inlier
        missed = sampson_distance(fit.F, pair.exact_x1[still], pair.exact_x2[still])
        found += bool(missed.mean() < 1.0)
    assert found >= 9


@pytest.mark.parametrize("seed", range(5))
def test_long_searches_give_the_same_bytes(seed):
    pair = make_pair(PairOptions(points=600, outliers=0.7, sigma_px=1.0), seed)
    settings = EpipolarSettings(max_error_px=2.0, max_trials=2000)
    fits = [fit_lev_ransac(pair.x1, pair.x2, settings, seed) for _ in range(5)]
    assert isinstance(fits[0], EpipolarFit)
    assert fits[0].trials > 300
    assert {(fit.F.tobytes(), fit.inliers.tobytes(), fit.priors.tobytes(), fit.trials) for fit in fits} == {
        (fits[0].F.tobytes(), fits[0].inliers.tobytes(), fits[0].priors.tobytes(), fits[0].trials)
    }
