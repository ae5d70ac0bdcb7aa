"""The consensus over all of K at once, and the verdict on its peak."""

import numpy as np
import pytest

from sfm_app.selfcal.consensus import (
    CONSENSUS,
    Consensus,
    ConsensusPeak,
    ambiguity_reason,
    best_rival,
    deviation,
    effective_count,
    peaks,
    rejection_reason,
    resample_peak,
    residual_sigma,
    scan,
    spread_px,
    support_reason,
    votes,
)
from sfm_app.selfcal.pairs import prepare
from sfm_app.types import CameraPairs

FREE = (0, 1, 2)


@pytest.fixture
def consensus(views):
    def make(**knobs):
        made = views(**knobs)
        frame = {"unit_px": float(made.size[0]), "origin_px": (made.size[0] / 2, made.size[1] / 2)}
        return Consensus(prepare(CameraPairs.from_Fs(made.Fs, made.size, made.weights), **frame), 0.15)

    return make


def truth(focal=1.0, u=0.0, v=0.0, aspect=1.0):
    return np.array([np.log(focal), u, v, np.log(aspect)])


def test_value_is_votes_plus_prior(consensus):
    made = Consensus(consensus().pairs, 0.15, np.linspace(0.1, 1, 15))
    theta = truth(1.1, 0.06, -0.03, 1.1)
    expected = np.sum(made.weights * np.exp(-made.ratios(theta) / 0.02)) - 0.5 * (0.06**2 + 0.03**2) / 0.15**2
    np.testing.assert_allclose(made.evaluate(np.stack([theta, truth()]), 0.02)[0], expected)
    assert votes(made, theta, 0.02).sum() == pytest.approx(expected + 0.5 * (0.06**2 + 0.03**2) / 0.15**2)


def test_ratios_vanish_at_the_truth_only(consensus):
    made = consensus(noise=0.0, aspect=1.2)
    assert made.ratios(truth(aspect=1.2)).max() < 1e-6
    assert np.median(made.ratios(truth())) > 0.01


def test_climbing_moves_what_is_free_and_never_down(consensus):
    made = consensus()
    start = truth(1.2, 0.05, 0.05, 1.1)
    theta, value = made.climb(start, (0, 2), (0.05,))
    np.testing.assert_array_equal(theta[[1, 3]], start[[1, 3]])
    assert value > made.evaluate(start[None], 0.05)[0] + 0.1
    assert value == pytest.approx(made.evaluate(theta[None], 0.05)[0])
    np.testing.assert_array_equal(start, truth(1.2, 0.05, 0.05, 1.1))


@pytest.mark.parametrize("focal", [0.5, 1.0, 2.5])
def test_the_highest_peak_is_the_truth(consensus, focal):
    made = consensus(focal=1000 * focal, center=(560, 340), noise=3e-4)
    profile = scan(made, (0.0,))
    assert profile.thetas.shape == (CONSENSUS.focals, 4)
    np.testing.assert_allclose(np.exp(profile.thetas[[0, -1], 0]), CONSENSUS.focal_range)
    found = peaks(made, profile, FREE)
    assert [peak.value for peak in found] == sorted((peak.value for peak in found), reverse=True)
    assert np.exp(found[0].theta[0]) == pytest.approx(focal, rel=0.05)
    np.testing.assert_allclose(found[0].theta[1:3], [0.06, -0.035], atol=0.04)


def test_own_sigma_follows_the_scatter_within_bounds(consensus):
    sigmas = [residual_sigma(consensus(noise=noise), truth()) for noise in (0.0, 5e-3, 0.2)]
    assert sigmas[0] == 0.005
    assert 0.005 < sigmas[1] < 0.02
    assert sigmas[2] == 0.02
    assert residual_sigma(consensus(), truth(0.01)) == 0.02  # nothing agrees


def test_effective_count():
    assert effective_count(np.ones(7)) == pytest.approx(7)
    assert effective_count(np.array([1, 1, 0, 0])) == pytest.approx(2)
    assert effective_count(np.zeros(3)) == 0


def test_few_votes_are_no_agreement_and_a_margin_must_count_and_weigh():
    assert support_reason(np.full(3, 0.9), np.ones(3)) == ""
    assert "agree" in support_reason(np.array([1.0, 0.2, 0.1]), np.ones(3))
    assert "agree" in support_reason(np.full(100, 0.05), np.ones(100))
    assert ambiguity_reason(0.6, np.ones(10)) == ""
    assert "other focals" in ambiguity_reason(0.4, np.ones(10))
    assert "other focals" in ambiguity_reason(2.0, np.ones(100))


def test_rivals_are_far_below_the_truth_and_level_with_it_on_an_orbit(views, consensus):
    for motion, low, high in ((None, 3.0, 15.0), (views.orbit, -0.1, 0.05)):
        made = consensus(noise=3e-4, **({"motion": motion} if motion else {}))
        value = made.evaluate(truth()[None], CONSENSUS.sigmas[-1])[0]
        for profile in (None, scan(made, (0.0,))):
            assert low < value - best_rival(made, truth(), FREE, CONSENSUS.sigmas, profile) < high


def test_resampling_scatters_with_the_noise_and_repeats(consensus):
    scatter = []
    for noise in (2e-4, 4e-3):
        made = consensus(noise=noise)
        start, _ = made.climb(truth(), FREE, (0.01,))
        thetas = resample_peak(made, start, FREE, 0.01, seed=1)
        np.testing.assert_array_equal(thetas, resample_peak(made, start, FREE, 0.01, seed=1))
        assert np.all(thetas[:, 3] == 0)
        scatter.append(np.std(thetas[:, 0]))
    assert 1e-5 < scatter[0] < 0.3 * scatter[1] < 0.02


def test_deviation_pays_for_the_parameters():
    values = np.random.default_rng(0).normal(size=1000)
    assert deviation(values, 1e6, 3) == pytest.approx(1, rel=0.1)
    assert deviation(values, 3.0, 3) == pytest.approx(np.sqrt(2) * np.std(values, ddof=1))
    assert np.isfinite(deviation(values, 0.0, 4))


def test_spread_is_in_pixels():
    rng = np.random.default_rng(0)
    thetas = rng.normal(size=(2000, 4)) * [0.01, 0.002, 0.003, 0.0] + [np.log(1.5), 0, 0, np.log(4)]
    spread = spread_px(thetas, 1000.0, 1e6, 4)
    assert list(spread) == ["fx", "fy", "cx", "cy"]
    assert list(spread.values()) == pytest.approx([7.5, 30, 2, 3], rel=0.1)


def rejection(theta, spread=0.001):
    return rejection_reason(np.array(theta), spread, (1000, 750))


def test_answers_of_agreeing_pairs_are_rejected_for_a_reason():
    assert rejection([0.0, 0.49, -0.37, 0.0]) == ""
    assert rejection([0.0, 0.0, 0.0, 0.0], spread=0.09) == ""
    assert "uncertain by 12 %" in rejection([0.0, 0.0, 0.0, 0.0], spread=0.12)
    assert "end of the range" in rejection([np.log(0.3), 0.0, 0.0, 0.0])
    assert "end of the range" in rejection([np.log(5.1), 0.0, 0.0, 0.0])
    assert "center" in rejection([0.0, 0.51, 0.0, 0.0])
    assert "center" in rejection([0.0, 0.0, -0.38, 0.0])


@pytest.mark.parametrize(
    ("margin", "missing", "doubted"), [(0.1, 0.4, True), (0.3, 0.4, False), (0.1, 0.1, False), (0.3, 0.1, False)]
)
def test_a_small_margin_counts_only_where_few_votes_are_missing(margin, missing, doubted):
    votes = np.full(10, 1.0 - missing)
    peak = ConsensusPeak(np.zeros(4), FREE, 0.01, margin * votes.sum(), votes, 0.0, ())
    assert bool(peak.rival_reason(np.ones(10))) is doubted
