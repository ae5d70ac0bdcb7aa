"""Weights from the epipolar residuals, against equal weights."""

from dataclasses import replace

import numpy as np
import pytest

from sfm_app.geometry.epipolar import eight_point
from sfm_app.selfcal.thesis import geometric, huang_faugeras
from sfm_app.settings import CalibrationSettings
from sfm_app.synthetic.correspondences import TrackOptions, make_tracks
from sfm_app.types import CameraPairs

OPTIONS = CalibrationSettings()


def tracked(seed, **options):
    """`CameraPairs` with matches and the true K, in the manner of thesis 5.5.3."""
    tracks = make_tracks(TrackOptions(sigma_px=0.5, **options), seed)
    Fs = np.array([eight_point(pair.x1, pair.x2) for pair in tracks.pairs.values()])
    inliers = tuple(np.hstack([pair.x1, pair.x2]) for pair in tracks.pairs.values())
    return replace(CameraPairs.from_Fs(Fs, tracks.size), inliers=inliers), tracks.K[0]


def focal_error(found, K):
    return abs(found.evidence["fx_px"] / K[0, 0] - 1) + abs(found.evidence["fy_px"] / K[1, 1] - 1)


def test_both_find_the_camera_of_good_pairs():
    pairs, K = tracked(0)
    for method in (geometric, huang_faugeras):
        found = method.calibrate(pairs, OPTIONS, 0)
        assert (found.identifiable, found.method) == (True, method.METHOD), found.reason
        assert 0 < focal_error(found, K) < 0.04


def test_residuals_tell_corrupted_pairs():
    gains = []
    for seed in range(5):
        pairs, K = tracked(seed, corrupted_pairs=2, outliers=0.3)
        weights = geometric.residual_weights(pairs)
        assert np.sort(weights)[1] < 0.1 < np.sort(weights)[2]
        assert np.mean(weights) == pytest.approx(1)
        errors = [focal_error(method.calibrate(pairs, OPTIONS, 0), K) for method in (geometric, huang_faugeras)]
        gains.append(errors[1] / errors[0])
    assert np.median(gains) > 2


def test_without_matches_the_given_weights_stand_in(views, random_fundamentals):
    made = views(5, noise=5e-4)
    Fs = np.concatenate([made.Fs, random_fundamentals(2)])
    pairs = CameraPairs.from_Fs(Fs, made.size, np.r_[np.ones(10), 1e-5, 1e-5])
    assert geometric.calibrate(pairs, OPTIONS, 0).evidence["fx_px"] == pytest.approx(1000, rel=0.03)
    assert huang_faugeras.calibrate(pairs, OPTIONS, 0).evidence["fx_px"] != pytest.approx(1000, rel=0.1)


def test_pairs_that_do_not_take_part_get_no_weight():
    pairs, _ = tracked(0)
    asked = replace(pairs, weights=np.r_[0.0, np.ones(9)], inliers=(*pairs.inliers[:-1], np.empty((0, 4))))
    weights = geometric.residual_weights(asked)
    assert weights[0] == weights[-1] == 0
    assert np.sum(weights) == pytest.approx(8)


def test_exact_matches_count_alike():
    tracks = make_tracks(TrackOptions(sigma_px=0.0), 0)
    inliers = tuple(np.hstack([pair.x1, pair.x2]) for pair in tracks.pairs.values())
    pairs = replace(CameraPairs.from_Fs(tracks.F, tracks.size), inliers=inliers)
    np.testing.assert_allclose(geometric.residual_weights(pairs), np.ones(10), rtol=1e-12)


def test_without_any_match_there_is_no_answer(views):
    made = views(3, noise=0.0)
    pairs = replace(CameraPairs.from_Fs(made.Fs, made.size), inliers=(np.zeros((0, 4)),) * 3)
    np.testing.assert_array_equal(geometric.residual_weights(pairs), np.zeros(3))
    assert "0 usable pairs" in geometric.calibrate(pairs, OPTIONS, 0).reason


def test_matches_for_other_pairs_are_refused(views):
    made = views(3)
    pairs = replace(CameraPairs.from_Fs(made.Fs, made.size), inliers=(np.zeros((5, 4)),))
    with pytest.raises(ValueError, match="inliers of 1 pairs"):
        geometric.calibrate(pairs, OPTIONS, 0)
