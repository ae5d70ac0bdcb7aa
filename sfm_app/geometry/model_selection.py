"""Choose which parameters of a camera are free: models compared by their marginal likelihood.

The marginal likelihood, by Laplace's approximation, is MacKay's (1992). About the present cameras the negative
log-likelihood of a step d is -g'd + d'Hd / 2. Every part of a camera (center, aspect, lens) has a narrow prior about
its usual value and a wide one; a choice says which of the two each part has. `camera_priors` asks pairs of photos in
this way, `lens_evidence` a whole bundle.
"""

from itertools import product
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sfm_app.geometry.spd_solve import inverses_of_positive

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]


class NormalPriors(NamedTuple):
    """Independent normal priors on n parameters, one row for each of K choices."""

    precision: FloatArray
    """(K, n) 1 / variance, > 0."""
    away: FloatArray
    """(K, n) from the present parameters to the priors' means."""
    log_odds: FloatArray
    """(K,) log-probability of each choice before the photos are asked."""


class Posteriors(NamedTuple):
    """What K choices make of the same likelihood."""

    log_evidence: FloatArray
    """(K,) log-probability of each choice, up to a constant."""
    steps: FloatArray
    """(K, n) posterior means, as steps from the present parameters."""
    covariances: FloatArray
    """(K, n, n)"""

    def mean_squares(self, about: FloatArray) -> FloatArray:
        """Return (n, n) the second moments over all choices, each counting by its probability.

        Args:
            about: (n,) the step that they are taken about.
        """
        odds = np.exp(self.log_evidence - self.log_evidence.max())
        odds /= odds.sum()
        off = self.steps - about
        return np.asarray(
            np.einsum("k,kij->ij", odds, self.covariances) + np.einsum("k,ki,kj->ij", odds, off, off), np.float64
        )


def binary_choices(count: int) -> BoolArray:
    """Return (2^count, count) all choices of what is freed; those that free less come first."""
    return np.array(sorted(product((False, True), repeat=count), key=sum), np.bool_)


def cavity(
    covariance: FloatArray, step: FloatArray, precision: FloatArray, away: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return H (n, n) and g (n,) of what all but a camera's own prior says about it: its posterior less that prior.

    Args:
        covariance: (n, n) of this camera in the posterior of all cameras.
        step: (n,) mean of the same.
        precision: (n,) of its prior.
        away: (n,) to its prior's mean.
    """
    marginal = inverses_of_positive(covariance)
    return marginal - np.diag(precision), marginal @ step - precision * away


def posteriors(H: FloatArray, g: FloatArray, priors: NormalPriors) -> Posteriors:
    """Return the posterior and the evidence of each of K choices.

    Args:
        H: (n, n) or (K, n, n) Hessian of the negative log-likelihood.
        g: (n,) or (K, n) its negative gradient.
        priors: of the K choices.
    """
    precision, away, log_odds = priors
    covariances = inverses_of_positive(H + precision[:, :, None] * np.eye(precision.shape[1]))
    pull = g + precision * away
    value = 0.5 * np.einsum("ki,kij,kj->k", pull, covariances, pull) - 0.5 * np.sum(precision * away**2, axis=1)
    value += 0.5 * np.sum(np.log(precision), axis=1) + 0.5 * np.linalg.slogdet(covariances)[1]
    return Posteriors(value + log_odds, np.einsum("kij,kj->ki", covariances, pull), covariances)
