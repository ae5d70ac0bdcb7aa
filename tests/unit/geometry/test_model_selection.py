"""Models are compared by the integral of likelihood times prior, and a camera's own prior is taken out again."""

import numpy as np
import pytest

from sfm_app.geometry.least_squares import NormalPriors, binary_choices, cavity, posteriors

H, G = np.array([[40.0]]), np.array([12.0])
PRIORS = NormalPriors(np.array([[100.0], [4.0]]), np.array([[0.1], [0.1]]), np.log([0.7, 0.3]))


def test_the_evidence_is_the_integral():
    d = np.linspace(-3.0, 3.0, 60001)
    integrals = [
        np.log(odds) + np.log(np.sum(np.exp(G[0] * d - 0.5 * H[0, 0] * d**2) * belief) * (d[1] - d[0]))
        for odds, belief in zip(
            (0.7, 0.3),
            (np.sqrt(p / (2 * np.pi)) * np.exp(-0.5 * p * (d - 0.1) ** 2) for p in (100.0, 4.0)),
            strict=True,
        )
    ]
    found = posteriors(H, G, PRIORS).log_evidence
    assert found[1] - found[0] == pytest.approx(integrals[1] - integrals[0], abs=1e-6)
    assert abs(found[1] - found[0]) > 0.05


def test_the_mean_squares_are_those_of_the_mixture():
    found = posteriors(H, G, PRIORS)
    odds = np.exp(found.log_evidence) / np.exp(found.log_evidence).sum()
    expected = sum(
        o * (c[0, 0] + (s[0] - 0.2) ** 2) for o, c, s in zip(odds, found.covariances, found.steps, strict=True)
    )
    assert found.mean_squares(np.array([0.2]))[0, 0] == pytest.approx(expected)


def test_the_cavity_takes_the_prior_out_again():
    precision, away = np.array([9.0, 25.0]), np.array([0.3, -0.2])
    likelihood, gradient = np.array([[50.0, 10.0], [10.0, 30.0]]), np.array([1.0, -2.0])
    covariance = np.linalg.inv(likelihood + np.diag(precision))
    back = cavity(covariance, covariance @ (gradient + precision * away), precision, away)
    np.testing.assert_allclose(back[0], likelihood)
    np.testing.assert_allclose(back[1], gradient)


def test_choices_that_free_less_come_first():
    assert binary_choices(2).tolist() == [[False, False], [False, True], [True, False], [True, True]]
