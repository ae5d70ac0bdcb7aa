"""Evidence for a peak of the joint consensus: how many pairs support it, its best rival, its stability.

Ours; the bootstrap is Rubin's (1981), the effective sample size Kish's (1965).
"""

from collections.abc import Sequence

import numpy as np

from sfm_app.selfcal.consensus.consensus import CENTER_U, CENTER_V, LOG_ASPECT, LOG_FOCAL, Consensus
from sfm_app.selfcal.consensus.peak_search import SIGMAS, Profile
from sfm_app.selfcal.inputs import FloatArray

OWN_SIGMA_RANGE = (0.005, 0.02)
"""The last width of the consensus follows the data within these bounds, in units of r. Chosen by hand; halved and
doubled by `benchmarks.sensitivity`."""
OWN_SIGMA_FACTOR = 1.5
"""That width in medians of r: half of the agreeing pairs then vote with more than half their weight.
docs/algorithms.md, Self-calibration, 1. Chosen by hand; halved and doubled by `benchmarks.sensitivity`."""
MIN_AGREEING = 2.25
"""Effective number of pairs that must agree; three parameters satisfy one and a half pairs in any case.
docs/algorithms.md, Self-calibration, 5. Chosen by hand; halved and doubled by `benchmarks.sensitivity`."""
MIN_SUPPORT = 0.12
"""Share of the votes that K must win; many pairs without any common K give up to 0.06. docs/algorithms.md,
Self-calibration, 5. The command that gave 0.06 is not on record."""
RIVAL_RATIO = 1.25
"""A K with a focal this many times longer or shorter is another answer. docs/algorithms.md, Self-calibration, 5. Chosen
by hand; halved and doubled by `benchmarks.sensitivity`."""
MIN_LEAD = 0.5
"""Votes by which K must lead every other focal. docs/algorithms.md, Self-calibration, 5. Chosen by hand; halved and
doubled by `benchmarks.sensitivity`."""
MIN_LEAD_SHARE = 0.03
"""That lead as a share of the votes for K: many pairs that barely distinguish focals do not determine one.
docs/algorithms.md, Self-calibration, 5. Chosen by hand; halved and doubled by `benchmarks.sensitivity`."""
RESAMPLES = 25
"""Number of resamples of the Bayesian bootstrap (docs/algorithms.md, Self-calibration, without matches). Chosen by
hand; halved and doubled by `benchmarks.sensitivity`."""
STABLE_SIGMA = 0.01
"""Resampled fits use at least this width: below it they snap to single pairs. Chosen by hand; halved and doubled by
`benchmarks.sensitivity`."""


def residual_sigma(consensus: Consensus, theta: FloatArray) -> float:
    """Return the width that fits the scatter of the agreeing pairs: 1.5 times the weighted median of their r.

    Args:
        consensus: of all pairs.
        theta: (4,) the peak.
    """
    r = consensus.ratios(theta)
    agreeing = r < SIGMAS[0]
    if not np.any(agreeing):
        return OWN_SIGMA_RANGE[1]
    order = np.argsort(r[agreeing], kind="stable")
    mass = np.cumsum(consensus.weights[agreeing][order])
    median = r[agreeing][order][np.searchsorted(mass, 0.5 * mass[-1])]
    return float(np.clip(OWN_SIGMA_FACTOR * median, *OWN_SIGMA_RANGE))


def votes(consensus: Consensus, theta: FloatArray, sigma: float) -> FloatArray:
    """Return (P,) votes of the pairs for K: w_i exp(-r_i / sigma).

    Args:
        consensus: of P pairs.
        theta: (4,) parameters of K.
        sigma: width of a vote, in units of r, > 0.
    """
    return np.asarray(consensus.weights * np.exp(-consensus.ratios(theta) / sigma))


def effective_count(votes: FloatArray) -> float:
    """Return the effective number of votes (Kish's effective sample size); 0 for no votes."""
    total, squares = float(np.sum(votes)), float(np.sum(votes**2))
    return total * total / squares if squares > 0 else 0.0


def disagreement(given: FloatArray, weights: FloatArray) -> str:
    """Return why the votes do not suffice for a camera; empty where they do.

    Args:
        given: (P,) votes for K.
        weights: (P,) the most that each pair can give.
    """
    count, support = effective_count(given), float(np.sum(given) / np.sum(weights))
    if count >= MIN_AGREEING and support >= MIN_SUPPORT:
        return ""
    return f"the pairs do not agree on a camera: {100 * support:.0f} % of the votes, worth {count:.1f} pairs"


def indecision(lead: float, given: FloatArray) -> str:
    """Return why a lead over the best rival is not enough; empty where it is.

    Args:
        lead: votes by which K leads.
        given: (P,) votes for K.
    """
    if lead >= max(MIN_LEAD, MIN_LEAD_SHARE * float(np.sum(given))):
        return ""
    return "the pairs fit other focals as well or better (too little rotation, parallel axes, or an orbit)"


def best_rival(
    consensus: Consensus,
    theta: FloatArray,
    free: Sequence[int],
    sigmas: Sequence[float],
    profile: Profile | None = None,
) -> float:
    """Return the highest value, at the last sigma, of a focal `RIVAL_RATIO` away with everything else adapted to it.

    It is climbed to from `theta` and, where a profile is given, from the best cell of the grid for that focal. Where
    the consensus does not depend on the focal (orbits, parallel axes) it equals the value at theta.

    Args:
        consensus: of all pairs.
        theta: (4,) the peak.
        free: places in theta that may move; the focal stays in any case.
        sigmas: falling widths of a vote.
        profile: best cells of the grid, from `scan`.
    """
    adapted = [index for index in free if index != LOG_FOCAL]
    values = []
    for log_focal in theta[LOG_FOCAL] + np.log(RIVAL_RATIO) * np.array([-1.0, 1.0]):
        starts = [theta.copy()]
        if profile is not None:
            starts.append(profile.thetas[np.argmin(np.abs(profile.thetas[:, LOG_FOCAL] - log_focal))].copy())
        for start in starts:
            start[LOG_FOCAL] = log_focal
            values.append(consensus.climb(start, adapted, sigmas)[1])
    return max(values)


def resample_peak(consensus: Consensus, theta: FloatArray, free: Sequence[int], sigma: float, seed: int) -> FloatArray:
    """Return the peak (RESAMPLES, 4) under randomly reweighted pairs: the Bayesian bootstrap (Rubin 1981).

    Weights instead of draws, because three pairs drawn with replacement are often one pair three times.

    Args:
        consensus: of all pairs.
        theta: (4,) the peak, where every climb starts.
        free: places in theta that may move.
        sigma: width of a vote, in units of r.
        seed: same seed, same result.
    """
    rng = np.random.default_rng(seed)
    weights = consensus.weights
    found = []
    for _ in range(RESAMPLES):
        drawn = weights * rng.exponential(size=len(weights))
        again = consensus.with_weights(drawn * (np.sum(weights) / np.sum(drawn)))
        found.append(again.climb(theta, free, (max(sigma, STABLE_SIGMA),))[0])
    return np.array(found)


def deviation(values: FloatArray, count: float, parameters: int) -> float:
    """Return the standard deviation of an unknown over resampled peaks, corrected for degrees of freedom.

    A pair gives two constraints. With three pairs and three unknowns half of the scatter has gone into the fit, and the
    resampled peaks scatter too little by the same share: the usual correction for degrees of freedom.

    Args:
        values: (B,) one unknown at each peak, B >= 2.
        count: effective number of pairs.
        parameters: number of unknowns.
    """
    spare = max(count - 0.5 * parameters, 0.5)
    return float(np.std(values, ddof=1) * np.sqrt(max(count, 1.0) / spare))


def spread_px(thetas: FloatArray, unit_px: float, count: float, parameters: int) -> dict[str, float]:
    """Return the standard deviations of fx, fy, cx, cy, in pixels; see `deviation`.

    Args:
        thetas: (B, 4) resampled peaks, B >= 2.
        unit_px: pixels per unit of theta.
        count: effective number of pairs.
        parameters: number of unknowns.
    """
    focal, half = np.exp(thetas[:, LOG_FOCAL]) * unit_px, np.exp(0.5 * thetas[:, LOG_ASPECT])
    columns = {"fx": focal / half, "fy": focal * half}
    columns |= {"cx": thetas[:, CENTER_U] * unit_px, "cy": thetas[:, CENTER_V] * unit_px}
    return {name: deviation(column, count, parameters) for name, column in columns.items()}
