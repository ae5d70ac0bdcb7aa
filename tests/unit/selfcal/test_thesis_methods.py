"""The other methods of thesis chapter 5, and the verdict that all literal methods share."""

from dataclasses import replace

import numpy as np
import pytest

from sfm_app.geometry.epipolar import eight_point
from sfm_app.selfcal.pairs import prepare
from sfm_app.selfcal.thesis import geometric, least_squares, multi_start, perturbation
from sfm_app.selfcal.thesis.multi_start import MOST_STARTS, USUAL_FOCAL, focal_distribution, number_of_starts
from sfm_app.selfcal.thesis.perturbation import discrepancy_weights, error_discrepancies
from sfm_app.selfcal.thesis.verdict import CameraParameters, calibrate_with
from sfm_app.settings import CalibrationSettings
from sfm_app.synthetic.correspondences import TrackOptions, make_tracks
from sfm_app.types import CameraPairs

OPTIONS = CalibrationSettings()


def run(method, Fs, seed=0):
    return method.calibrate(CameraPairs.from_Fs(Fs, (1000, 750)), OPTIONS, seed)


@pytest.mark.parametrize(("pairs", "starts"), [(3, 1), (4, 11), (10, 358), (21, 3983), (45, MOST_STARTS)])
def test_as_many_starts_as_draw_any_triple_with_95_percent(pairs, starts):
    assert number_of_starts(pairs) == starts


def test_focals_are_drawn_around_those_of_the_pairs_or_the_usual_one(views):
    made, parallel = views(6, noise=1e-3, focal=1300), views(4, noise=0.0, motion=views.translation)
    (mean, deviation), usual = (
        focal_distribution(prepare(CameraPairs.from_Fs(one.Fs, one.size), unit_px=1000.0, origin_px=(0.0, 0.0)), 0.75)
        for one in (made, parallel)
    )
    assert 0 < abs(mean - 1.3) < 0.2
    assert 0.001 < deviation < 0.5
    assert usual == USUAL_FOCAL


def test_the_three_pairs_of_three_photos_have_an_answer_but_no_confirmation(views):
    found = run(multi_start, views(3, noise=1e-4).Fs)
    assert found.evidence["starts"] == 1
    assert "no other pairs" in found.reason
    assert found.evidence["fx_px"] == pytest.approx(1000, rel=0.1)


def test_an_error_of_k_alone_stays_within_the_bound(views):
    # (5.21) with exact F's: for an error of any size; -error leads from the estimate back to the truth
    made, rng = views(6, noise=0.0), np.random.default_rng(0)
    for size in (1.0, 100.0, 500.0):
        error = np.array([[1, 0, 1], [0, 1, 1], [0, 0, 0]]) * rng.normal(0, size, (3, 3))
        found = error_discrepancies(made.Fs, made.K + error, -error)
        assert 1e-4 < found.max() <= 1


def test_a_noisy_pair_stands_out(views):
    made = views(6, noise=0.0)
    noisy = made.Fs.copy()
    noisy[3] = views(6, noise=0.1).Fs[3]
    change = np.diag([10.0, 10.0, 0.0])
    discrepancies = error_discrepancies(noisy, made.K + change, change)
    assert np.argmax(discrepancies) == 3
    assert discrepancies[3] > 10 * np.median(discrepancies)
    weights = discrepancy_weights(discrepancies)
    assert weights[3] < 0.05 < np.median(weights)


def test_weights_fall_with_the_discrepancy():
    weights = discrepancy_weights(np.array([2.0, 1.0, 3.0, 1e9]))
    scale = 1.4826 * 1.0  # deviations from the median 2.5: 0.5, 1.5, 0.5, huge
    np.testing.assert_allclose(weights[:3], np.exp(-np.array([1.0, 0.0, 2.0]) / scale))
    assert weights[3] == 0


def test_discrepancies_that_do_not_scatter_leave_equal_weights():
    np.testing.assert_array_equal(discrepancy_weights(np.array([4.0, 4.0, 4.0, 9.0])), np.ones(4))


def test_it_outdoes_equal_weights_where_pairs_are_wrong(views, random_fundamentals):
    errors = {perturbation: [], least_squares: []}
    for seed in range(4):
        Fs = views(6, seed, noise=3e-4).Fs.copy()
        Fs[[2, 9]] = random_fundamentals(2, seed)
        for method, off in errors.items():
            evidence = run(method, Fs).evidence
            off.append(abs(evidence["fx_px"] - 1000) + abs(evidence["fy_px"] - 1000))
    assert np.median(errors[perturbation]) < 0.2 * np.median(errors[least_squares])


def test_good_pairs_keep_their_say(views):
    made = views(6, noise=5e-4)
    found = run(perturbation, made.Fs)
    assert (found.identifiable, found.method) == (True, perturbation.METHOD), found.reason
    assert 0 < np.abs(found.K - made.K).max() < 30
    assert 2 <= found.evidence["iterations"] <= 4
    assert 3 < found.evidence["weighted_pairs"] <= 15


def test_exact_pairs_end_it_early(views):
    made = views(5, noise=0.0)
    found = run(perturbation, made.Fs)
    assert found.evidence["iterations"] < 4
    assert pytest.approx(made.K, abs=0.5) == found.K


def tracked(seed, **options):
    """`CameraPairs` with matches and the true K, in the manner of thesis 5.5.3."""
    tracks = make_tracks(TrackOptions(sigma_px=0.5, **options), seed)
    Fs = np.array([eight_point(pair.x1, pair.x2) for pair in tracks.pairs.values()])
    inliers = tuple(np.hstack([pair.x1, pair.x2]) for pair in tracks.pairs.values())
    return replace(CameraPairs.from_Fs(Fs, tracks.size), inliers=inliers), tracks.K[0]


def focal_error(found, K):
    return abs(found.evidence["fx_px"] / K[0, 0] - 1) + abs(found.evidence["fy_px"] / K[1, 1] - 1)


def test_residuals_tell_corrupted_pairs():
    gains = []
    for seed in range(5):
        pairs, K = tracked(seed, corrupted_pairs=2, outliers=0.3)
        weights = geometric.residual_weights(pairs)
        assert np.sort(weights)[1] < 0.1 < np.sort(weights)[2]
        assert np.mean(weights) == pytest.approx(1)
        errors = [focal_error(method.calibrate(pairs, OPTIONS, 0), K) for method in (geometric, least_squares)]
        gains.append(errors[1] / errors[0])
    assert np.median(gains) > 2


def test_without_matches_the_given_weights_stand_in(views, random_fundamentals):
    made = views(5, noise=5e-4)
    Fs = np.concatenate([made.Fs, random_fundamentals(2)])
    pairs = CameraPairs.from_Fs(Fs, made.size, np.r_[np.ones(10), 1e-5, 1e-5])
    assert geometric.calibrate(pairs, OPTIONS, 0).evidence["fx_px"] == pytest.approx(1000, rel=0.03)
    assert least_squares.calibrate(pairs, OPTIONS, 0).evidence["fx_px"] != pytest.approx(1000, rel=0.1)


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


def judged(made, answer):
    return calibrate_with("mine", CameraPairs.from_Fs(made.Fs, made.size), lambda *_: answer)


def camera_of(made, factor=1.0):
    K = made.K / made.size[0]
    return CameraParameters(factor * K[0, 0], factor * K[1, 1], K[0, 2], K[1, 2])


def test_a_camera_that_the_pairs_support_is_known(views):
    made = views(5, aspect=1.1, center=(520, 350))
    found = judged(made, camera_of(made))
    assert (found.identifiable, found.method, found.reason) == (True, "mine", "")
    np.testing.assert_allclose(found.K, made.K)
    assert 0.9 < found.evidence["support"] < 1
    assert found.evidence["lead"] > 1


@pytest.mark.parametrize("factor", [0.6, 1.4])
def test_a_wrong_one_is_not_but_the_evidence_keeps_it(views, factor):
    made = views(5)
    found = judged(made, camera_of(made, factor))
    assert not found.identifiable
    assert "the pairs" in found.reason
    assert found.K[0, 0] == 1200
    names = ("fx_px", "fy_px", "cx_px", "cy_px")
    assert [found.evidence[name] for name in names] == pytest.approx([1000 * factor, 1000 * factor, 500, 375])


def test_any_camera_that_parallel_axes_fit_is_undecided(views):
    made = views(5, motion=views.translation)
    found = judged(made, camera_of(made))
    assert "other focals" in found.reason


@pytest.mark.parametrize(("sample", "known"), [(0, True), (3, False), (10, False), (12, False)])
def test_pairs_that_were_fitted_do_not_speak_for_the_answer(views, random_fundamentals, sample, known):
    Fs = np.concatenate([views(3).Fs, random_fundamentals(7)])
    found = calibrate_with(
        "mine", CameraPairs.from_Fs(Fs, (1000, 750)), lambda *_: CameraParameters(1.0, 1.0, 0.5, 0.375), sample
    )
    assert found.identifiable == known
    assert 0.2 < found.evidence["support"] < 0.4


def test_a_method_may_have_no_answer(views):
    found = judged(views(4), "no curve")
    assert (found.identifiable, found.reason, found.method) == (False, "no curve", "guess")


def test_two_pairs_are_too_few_to_ask(views):
    made = views(3)
    pairs = CameraPairs.from_Fs(made.Fs[:2], made.size)
    found = calibrate_with("mine", pairs, lambda *_: pytest.fail("asked"))
    assert found.reason == "2 usable pairs, 3 are needed"
