"""Tests for OpenCV's estimators alone; those that all estimators pass are in tests/contract."""

import pytest

pytest.importorskip("sfm_app_opencv", reason="the plug-in is not installed: pip install -e plugins/opencv")

import cv2
import numpy as np
import sfm_app_opencv

import sfm_app
from sfm_app.geometry.epipolar import sampson_distance
from sfm_app.settings import EpipolarSettings
from sfm_app.synthetic.correspondences import PairOptions, make_pair
from sfm_app.types import Rejected

OPTIONS = EpipolarSettings(max_error_px=1.5, max_trials=2000, min_inliers=8)
PAIR = make_pair(PairOptions(points=1000, outliers=0.3, sigma_px=1.5), 1)
FITS = {
    "opencv-magsac": sfm_app_opencv.fit_magsac,
    "opencv-usac": sfm_app_opencv.fit_usac,
    "opencv-usac-accurate": sfm_app_opencv.fit_usac_accurate,
    "opencv-ransac": sfm_app_opencv.fit_ransac,
}


@pytest.mark.parametrize("name", FITS)
def test_it_is_found_by_name_and_differs_from_the_others(name):
    settings = sfm_app.Settings(epipolar=OPTIONS)

    found = sfm_app.estimate_fundamental(PAIR.x1, PAIR.x2, method=name, seed=3, settings=settings)

    np.testing.assert_array_equal(found.F, FITS[name](PAIR.x1, PAIR.x2, OPTIONS, 3).F)
    others = [fit(PAIR.x1, PAIR.x2, OPTIONS, 3) for other, fit in FITS.items() if other != name]
    assert not any(np.array_equal(found.F, other.F) for other in others)


@pytest.mark.parametrize(("flag", "scale"), [(cv2.USAC_DEFAULT, 1), (cv2.USAC_MAGSAC, 1), (cv2.FM_RANSAC, np.sqrt(2))])
def test_the_threshold_means_in_opencv_what_the_plug_in_says(flag, scale):
    F, mask = cv2.findFundamentalMat(PAIR.x1, PAIR.x2, flag, 1.5 * scale, 0.999, 2000)
    inside = mask.ravel() == 1
    distance = sampson_distance(F, PAIR.x1, PAIR.x2)
    assert inside.sum() > 300
    assert 1.4 < distance[inside].max() < 1.51
    # USAC accepts every match within the threshold; RANSAC also requires both distances to be small
    assert np.mean(distance[~inside] < 1.5) <= (0.0 if scale == 1 else 0.2)


@pytest.mark.parametrize("name", FITS)
def test_the_seed_acts(name):
    found = [FITS[name](PAIR.x1, PAIR.x2, OPTIONS, seed).F.tobytes() for seed in (0, 1, 0)]
    assert found[0] == found[2] != found[1]


@pytest.mark.parametrize(
    "answer", [None, np.zeros((9, 3)), np.full((3, 3), np.nan), np.zeros((3, 3)), cv2.error("bad")]
)
def test_whatever_opencv_answers_becomes_a_value(monkeypatch, answer):
    def find(*_):
        if isinstance(answer, cv2.error):
            raise answer
        return answer, None

    monkeypatch.setattr(cv2, "findFundamentalMat", find)
    assert sfm_app_opencv.fit_usac(PAIR.x1, PAIR.x2, OPTIONS, 0) == Rejected("no model found")
