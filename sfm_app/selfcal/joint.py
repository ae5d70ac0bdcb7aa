"""The consensus of all pairs over all of K at once.

Thesis (5.33) seeks the point where most zero curves meet, in one plane of K at a time. Here the same is asked of the
whole of K: at the parameters ``theta = (log f, u, v, log a)``, with f = sqrt(fx fy) and a = fy / fx, how many pairs
satisfy the constraint? Each pair speaks with at most its weight, so outliers do not pull::

    support(theta) = sum_i w_i exp(-r_i(theta) / sigma),      r = (s1 - s2) / (s1 + s2) of E_i = K'F_iK

A pair's say is read as a log-likelihood, so that a prior on the centre adds to it: it decides where pairs are few and
fades where they are many.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import minimize

from sfm_app.jit import kernel
from sfm_app.selfcal.constraints import singular_value_ratio
from sfm_app.selfcal.inputs import FloatArray, Pairs

LOG_FOCAL, CENTRE_U, CENTRE_V, LOG_ASPECT = range(4)
"""Places in theta."""
FIRST_STEPS = np.array([0.05, 0.03, 0.03, 0.05])
"""First steps of the local search along theta."""
RESTARTS = 2
"""Runs of the local search, each from the end of the last with a tenth of its steps: a simplex can stall on a ridge."""


@dataclass(frozen=True, slots=True, eq=False)
class Consensus:
    """The function that the right K maximises."""

    pairs: Pairs
    centre_sigma: float
    """Standard deviation of the prior on (u, v) about (0, 0), in units of the pairs."""

    def weighted(self, weights: FloatArray) -> "Consensus":
        """The same pairs with other weights (P,)."""
        return replace(self, pairs=replace(self.pairs, weights=weights))

    def at(self, thetas: FloatArray, sigma: float) -> FloatArray:
        """(N,) supports plus log-priors at the rows of `thetas` (N, 4)."""
        p = self.pairs
        prior = -0.5 * np.sum(thetas[:, CENTRE_U : CENTRE_V + 1] ** 2, axis=1) / self.centre_sigma**2
        return np.asarray(supports(p.F, p.e1, p.e2, p.product, p.weights, thetas, sigma) + prior)

    def ratios(self, theta: FloatArray) -> FloatArray:
        """(P,) r_i at theta."""
        p = self.pairs
        return ratios(p.F, p.e1, p.e2, p.product, theta)

    def climb(self, start: FloatArray, free: Sequence[int], sigmas: Sequence[float]) -> tuple[FloatArray, float]:
        """The local maximum reached from `start` by moving the entries `free` of theta, through falling sigmas.

        Nelder-Mead, because the consensus has a cusp wherever a pair is satisfied exactly.

        Returns:
            theta (4,) and the value there, at the last sigma.
        """
        indices = list(free)
        theta = start.copy()
        value = 0.0
        for sigma in sigmas:

            def loss(moved: FloatArray, sigma: float = sigma) -> float:
                trial = theta.copy()
                trial[indices] = moved
                return -float(self.at(trial[None, :], sigma)[0])

            for shrink in 0.1 ** np.arange(RESTARTS):
                simplex = theta[indices] + np.vstack([np.zeros(len(indices)), np.diag(shrink * FIRST_STEPS[indices])])
                found = minimize(
                    loss,
                    theta[indices],
                    method="Nelder-Mead",
                    options={"initial_simplex": simplex, "xatol": 1e-5, "fatol": 1e-6, "maxiter": 300, "maxfev": 600},
                )
                theta[indices] = found.x
                value = -float(found.fun)
        return theta, value


@kernel
def ratios(F: FloatArray, e1: FloatArray, e2: FloatArray, product: FloatArray, theta: FloatArray) -> FloatArray:
    """(P,) r_i at theta = (log f, u, v, log a)."""
    fx, fy = np.exp(theta[0] - 0.5 * theta[3]), np.exp(theta[0] + 0.5 * theta[3])
    r = np.empty(len(F))
    for i in range(len(F)):
        r[i] = singular_value_ratio(F[i], e1[i], e2[i], product[i], fx, fy, theta[1], theta[2])
    return r


@kernel
def supports(
    F: FloatArray,
    e1: FloatArray,
    e2: FloatArray,
    product: FloatArray,
    weights: FloatArray,
    thetas: FloatArray,
    sigma: float,
) -> FloatArray:
    """(N,) sum_i w_i exp(-r_i / sigma) at the rows of `thetas` (N, 4)."""
    found = np.zeros(len(thetas))
    for k in range(len(thetas)):
        r = ratios(F, e1, e2, product, thetas[k])
        for i in range(len(r)):
            found[k] += weights[i] * np.exp(-r[i] / sigma)
    return found
