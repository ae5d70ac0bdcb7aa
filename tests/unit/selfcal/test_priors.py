"""The choice of free parameters, and hierarchical priors."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from sfm_app.camera.models import ASPECT, CENTER, FOCAL, LENS, WIDE
from sfm_app.selfcal import priors
from sfm_app.selfcal.priors import PRIORS, CameraPriors, Evidence, claim_rows, redundancy
from sfm_app.selfcal.zero_curves import calibrate
from sfm_app.settings import CalibrationSettings
from sfm_app.types import CameraPrior

OPTIONS = CalibrationSettings()
NOTHING = np.zeros((1, 4), np.bool_)
NO_CLAIM = claim_rows([None], [(1000, 750)], 1000.0)


def claimed(focal, deviation=0.05, count=1):
    """Claims of a focal in longer sides about the first of some cameras."""
    priors = [CameraPrior("a net", 1000.0 * focal, 1000.0 * focal * deviation)] + [None] * (count - 1)
    return claim_rows(priors, [(1000, 750)] * count, 1000.0)


def freed(*places):
    free = NOTHING.copy()
    free[0, list(places)] = True
    return free


def evidence(deviations, offset=(0.0,) * 5, claim=NO_CLAIM, theta=(0.0,) * 5, pairs=1e6):
    """Pairs with the answer theta + offset and these standard deviations."""
    H = np.diag(np.asarray(deviations, float) ** -2.0)
    return Evidence(np.array([theta]), H, H @ np.asarray(offset), pairs, CameraPriors(np.ones(1), claim))


SURE = [1e-3] * 5


@pytest.mark.parametrize(
    ("offset", "place"), [((0, 0.05, 0, 0, 0), CENTER), ((0, 0, 0, 0.1, 0), ASPECT), ((0, 0, 0, 0, 0.08), LENS)]
)
def test_sure_pairs_free_the_part_that_they_contradict(offset, place):
    np.testing.assert_array_equal(evidence(SURE, offset).choose(NOTHING), freed(place))


def test_usual_cameras_stay_usual_and_unsure_pairs_free_nothing():
    for deviation in (1e-3, 0.01, 0.1, 1.0):
        np.testing.assert_array_equal(evidence([deviation] * 5).choose(freed(CENTER, ASPECT, LENS)), NOTHING)
    np.testing.assert_array_equal(evidence([0.1] * 5, (0, 0.05, 0, 0.1, 0.08)).choose(NOTHING), NOTHING)


def test_the_log_evidence_is_the_integral():
    # over log f and u, the other parameters known
    found = evidence([0.05, 0.02, 1e-8, 1e-8, 1e-8], (0.1, 0.04, 0, 0, 0), theta=(0.3, 0.01, 0, 0, 0))
    f, u = np.meshgrid(np.linspace(-1, 1, 801), np.linspace(-0.4, 0.4, 801), indexing="ij")
    values = []
    for free in (NOTHING, freed(CENTER)):
        prior = found.priors.prior(free, found.thetas)
        likelihood = found.g[0] * f + found.g[1] * u - 0.5 * (found.H[0, 0] * f**2 + found.H[1, 1] * u**2)
        belief = sum(
            0.5 * np.log(prior.precision[0, k] / (2 * np.pi))
            - 0.5 * prior.precision[0, k] * (found.thetas[0, k] + d - prior.mean[0, k]) ** 2
            for k, d in ((0, f), (1, u))
        )
        integral = np.sum(np.exp(likelihood + belief)) * (f[1, 0] - f[0, 0]) * (u[0, 1] - u[0, 0])
        # the second center parameter is known to be 0: its prior density there is the rest
        rest = 0.5 * np.log(prior.precision[0, 2])
        values.append(np.log(integral) + rest + found.priors.log_odds(free))
    posteriors = [found.posterior(free)[0] for free in (NOTHING, freed(CENTER))]
    assert posteriors[1] - posteriors[0] == pytest.approx(values[1] - values[0], abs=1e-3)
    assert abs(values[1] - values[0]) > 0.5


def test_mean_step_and_covariance_are_those_of_two_measurements():
    found = evidence([0.1, 0.3, 0.3, 0.3, 0.3], (0.2, 0, 0, 0, 0))
    prior = found.priors.prior(NOTHING, found.thetas)
    _, step, covariance = found.posterior(NOTHING)
    weights = np.array([100.0, prior.precision[0, 0]])
    share = redundancy(NOTHING, 1e6)
    weights[0] *= share
    assert step[0] == pytest.approx(weights @ [0.2, prior.mean[0, 0]] / weights.sum())
    assert covariance[0, 0] == pytest.approx(1 / weights.sum())


def test_a_claim_counts_where_pairs_are_weak_and_loses_against_strong_ones():
    claim = claimed(1.0)
    weak, strong = evidence([0.3] * 5, (0.1, 0, 0, 0, 0), claim), evidence(SURE, (0.3, 0, 0, 0, 0), claim)
    assert not weak.choose(NOTHING)[0, FOCAL]
    assert abs(weak.posterior(NOTHING)[1][0]) < 0.01
    assert 0.8 * 0.05 < np.sqrt(weak.covariance(NOTHING)[0, 0]) < 0.3
    assert strong.choose(NOTHING)[0, FOCAL]
    assert strong.posterior(strong.choose(NOTHING))[1][0] == pytest.approx(0.3, abs=1e-3)


def test_without_a_claimed_focal_none_is_freed():
    found = evidence(SURE)
    assert found.posterior(freed(FOCAL))[0] == pytest.approx(found.posterior(NOTHING)[0])
    assert not found.choose(NOTHING)[0, FOCAL]


@pytest.mark.parametrize("offset", [0.0, 0.015, 0.022, 0.03, 0.1])
def test_the_covariance_covers_all_choices(offset):
    found = evidence([0.02, 0.01, 0.01, 0.01, 0.02], (0, offset, 0, 0, 0))
    H = found.H.copy()
    H[0, 1] = H[1, 0] = 0.5 * np.sqrt(H[0, 0] * H[1, 1])
    found = replace(found, H=H)
    best = found.choose(NOTHING)
    mixed = found.covariance(best)
    np.testing.assert_allclose(mixed, mixed.T, rtol=1e-9)
    assert np.linalg.eigvalsh(mixed).min() > 0
    widest = found.posterior(freed(CENTER, ASPECT, LENS))[2]
    assert np.all(np.diag(mixed) >= 0.5 * np.diag(found.posterior(best)[2]))
    assert mixed[3, 3] < widest[3, 3]


def test_nearly_freed_parts_are_nearly_as_uncertain():
    at = [np.sqrt(evidence([0.02] * 5, (0, u, 0, 0, 0)).covariance(NOTHING)[1, 1]) for u in (0.0, 0.04, 0.06)]
    assert at[0] < 0.016 < at[1] < 0.05
    assert at[1] > 1.1 * at[0]


def test_few_pairs_say_less_than_their_scatter():
    free = freed(CENTER, ASPECT, LENS)
    assert redundancy(free, 1e9) == pytest.approx(1.0)
    assert redundancy(NOTHING, 3.0) == pytest.approx(1 - 1 / 6)
    assert redundancy(free, 5.0) == pytest.approx(0.5)
    assert redundancy(free, 0.0) == redundancy(free, 1.0) == 0.1


def test_every_camera_has_its_own_choice():
    H = np.diag([1e6] * 10)
    g = H @ [0, 0, 0, 0, 0, 0, 0, 0, 0.1, 0]
    both = Evidence(np.zeros((2, 5)), H, g, 1e6, CameraPriors(np.ones(2), np.full((2, 2, 5), np.nan)))
    np.testing.assert_array_equal(both.choose(np.zeros((2, 4), np.bool_)), np.vstack([NOTHING, freed(ASPECT)]))


def test_k1_is_held_in_focal_lengths():
    lens = CameraPriors(np.ones(1), NO_CLAIM)
    for log_focal in (-0.5, 0.0, 0.8):
        precision = lens.prior(freed(LENS), np.array([[log_focal, 0, 0, 0, 0]])).precision[0, 4]
        assert precision**-0.5 * np.exp(2 * log_focal) == pytest.approx(WIDE[LENS])


@pytest.mark.parametrize("claim", [500.0, 850.0, 1180.0, 4000.0])
def test_a_wrong_claim_does_not_move_the_answer(shots, claim):
    made = shots(6, 3)
    found = calibrate(replace(made.pairs, prior=CameraPrior("a net", claim, 0.05 * claim)), OPTIONS, 0)
    assert found.identifiable, found.reason
    assert 0 < abs(found.K[0, 0] - 1000) < 3 * found.spread["fx"] < 20


def test_a_wrong_center_is_rejected_alone(shots):
    made = shots(6, 3)
    claims = [CameraPrior("a net", 1000.0, 10.0, center, 12.0) for center in ((430.0, 375.0), (501.0, 374.0))]
    plain, wrong, right = (calibrate(replace(made.pairs, prior=prior), OPTIONS, 0) for prior in (None, *claims))
    assert np.abs(wrong.K - plain.K).max() < np.abs(wrong.K[0, 2] - 430.0) / 10
    assert right.spread["cx"] < 1.01 * plain.spread["cx"] and abs(right.K[0, 2] - 500.0) < 3 * right.spread["cx"]


def test_a_right_claim_helps_weak_pairs(shots):
    spreads = []
    for prior in (None, CameraPrior("a net", 1005.0, 50.0)):
        made = shots(4, 0, motion=shots.level, points=80, noise_px=1.0, prior=prior)
        found = calibrate(made.pairs, OPTIONS, 0)
        spreads.append(found.evidence["log_focal_spread"])
    assert spreads[1] < 0.8 * spreads[0]
    assert spreads[1] < 0.08


def prior(families, free_focal=False, claims=None, focals=(1.0, 2.0, 4.0)):
    thetas = np.zeros((3, 5))
    thetas[:, 0] = np.log(focals)
    tied = priors.TiedPriors(
        np.ones(3), np.full((2, 3, 5), np.nan) if claims is None else claims, families=np.array(families)
    )
    free = np.zeros((3, 4), np.bool_)
    free[:, 3] = free_focal
    return tied.prior(free, thetas)


def test_focals_of_a_family_scatter_about_their_mean():
    found = prior([0, 0, 0])
    assert found.precision[:, 0] == pytest.approx(PRIORS.family_spread**-2)
    # drawn towards the usual focal by a prior of 0.7 beside three of 0.3
    share = 3 / PRIORS.family_spread**2 / (3 / PRIORS.family_spread**2 + 0.7**-2)
    assert found.mean[:, 0] == pytest.approx(PRIORS.usual_log_focal + share * (np.log(2) - PRIORS.usual_log_focal))


def test_families_are_apart_and_a_single_member_keeps_the_usual_focal():
    found = prior([-1, 5, -1])
    assert found.mean[:, 0] == pytest.approx(PRIORS.usual_log_focal)
    assert found.precision[:, 0] == pytest.approx(0.7**-2)
    two = prior([0, 0, 1])
    assert two.mean[0, 0] == two.mean[1, 0] != two.mean[2, 0]


def test_a_claim_comes_before_the_family():
    found = prior([0, 0, 0], claims=claimed(3.0, count=3))
    assert found.mean[0, 0] == pytest.approx(np.log(3))
    assert found.precision[0, 0] > 10 * found.precision[1, 0]
    freed = prior([0, 0, 0], free_focal=True, claims=claimed(3.0, count=3))
    assert freed.mean[0, 0] == freed.mean[1, 0]


def test_of_two_cameras_that_explain_the_same_only_one_is_freed():
    """The pairs know the sum of both aspects alone: once one camera has taken it, nothing is left for the other."""
    both = np.zeros(10)
    both[[3, 8]] = 1.0
    known = 1e6 * np.outer(both, both)
    priors = CameraPriors(np.ones(2), np.full((2, 2, 5), np.nan))
    evidence = Evidence(np.zeros((2, 5)), known, 0.2 * known @ both / 2.0, 1e6, priors)
    assert evidence.choose(np.zeros((2, 4), np.bool_))[:, 1].sum() == 1


class TurningEvidence(Evidence):
    """Always finds the opposite choice more probable."""

    def posterior(self, _):
        return 0.0, np.zeros(5), np.eye(5)

    def camera_posteriors(self, free, *_):
        return ~free[None], SimpleNamespace(log_evidence=np.zeros(1))


def test_choices_that_return_end_the_search():
    turning = TurningEvidence(np.zeros((1, 5)), np.eye(5), np.zeros(5), 4.0, CameraPriors(np.ones(1), NO_CLAIM))
    free = np.array([[True, False, False, True]])
    np.testing.assert_array_equal(turning.choose(free), free)
