"""The constraint of one F on K, and the K that most pairs agree on, with the evidence for and against it.

F has rank 2, so E = K'FK has singular values s1 >= s2 and 0, and Huang and Faugeras's constraint s1 = s2 (thesis 5.2.4,
5.8.2) follows from two numbers without an SVD: a = tr(EE') = s1^2 + s2^2, the sum of the squared entries of E, and
p = (s1 s2)^2, the sum of its squared 2x2 minors. With unit epipoles e1, e2, and q the product of F's singular values::

    p = q^2 |adj(K) e2|^2 |adj(K) e1|^2

Thesis (5.33) seeks the point where most zero curves meet, in one plane of K at a time. Here all of K is searched at
once: at the parameters ``theta = (log f, u, v, log a)``, with f = sqrt(fx fy) and a = fy / fx, each pair votes with at
most its weight, so that outliers have little influence::

    support(theta) = sum_i w_i exp(-r_i(theta) / sigma),    r = (s1 - s2) / (s1 + s2) of E_i = K'F_iK

A vote is taken as a log-likelihood, and a log-prior on the center is added. The evidence is ours: the bootstrap is
Rubin's (1981), the effective sample size Kish's (1965).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from sfm_app.jit import kernel
from sfm_app.selfcal.pairs import CENTER_U, CENTER_V, LOG_ASPECT, LOG_FOCAL, Pairs
from sfm_app.types.arrays import FloatArray


@kernel
def singular_value_ratio(pair: FloatArray, fx: float, fy: float, u: float, v: float) -> float:
    """Return r = (s1 - s2) / (s1 + s2) of E = K'FK, in [0, 1]; 0 where K satisfies the constraint.

    Unlike thesis (5.8) it is bounded, symmetric in the two views, and free of the scale of F. `pair` is a row (16,) of
    `Pairs.packed_rows`.
    """
    f11, f12, f13 = pair[0], pair[1], pair[2]
    f21, f22, f23 = pair[3], pair[4], pair[5]
    f31, f32, f33 = pair[6], pair[7], pair[8]
    g13, g23 = f11 * u + f12 * v + f13, f21 * u + f22 * v + f23
    g31, g32 = f11 * u + f21 * v + f31, f12 * u + f22 * v + f32
    g33 = f31 * u + f32 * v + f33 + u * g13 + v * g23
    x, y = fx * fx, fy * fy
    a = x * x * f11 * f11 + x * y * (f12 * f12 + f21 * f21) + y * y * f22 * f22
    a += x * (g13 * g13 + g31 * g31) + y * (g23 * g23 + g32 * g32) + g33 * g33
    n1 = y * (pair[9] - u * pair[11]) ** 2 + x * (pair[10] - v * pair[11]) ** 2 + x * y * pair[11] ** 2
    n2 = y * (pair[12] - u * pair[14]) ** 2 + x * (pair[13] - v * pair[14]) ** 2 + x * y * pair[14] ** 2
    twice = 2.0 * pair[15] * np.sqrt(n1 * n2)
    if not a + twice > 0.0:
        return 1.0
    # (s1 - s2)^2 / (s1 + s2)^2; rounding may push the numerator below zero
    return float(np.sqrt(max(a - twice, 0.0) / (a + twice)))


SQUARE_PIXELS = (LOG_FOCAL, CENTER_U, CENTER_V)
"""Places in theta that are free for square pixels."""
ANY_PIXELS = (*SQUARE_PIXELS, LOG_ASPECT)
"""Places in theta that are free for any pixels."""


class CONSENSUS:
    """Search and verdict. Sections are those of docs/algorithms/zero-curves.md."""

    first_steps: tuple[float, ...] = (0.05, 0.03, 0.03, 0.05)
    """First steps of a local search along theta; by hand."""
    focal_range: tuple[float, float] = (0.3, 5.0)
    """Focals of the grid, in longer sides: 118 to 11 degrees of view. Section 5; by hand."""
    focals: int = 29
    """Focals of the grid, 10 % apart; by hand."""
    center_reach: float = 0.4
    """Largest distance of a center of the grid from the middle along an axis, in longer sides; by hand."""
    center_step: float = 0.08
    """Distance of two centers of the grid, in longer sides; by hand."""
    log_aspects: tuple[float, ...] = tuple(np.linspace(-0.6, 0.6, 9))
    """log fy/fx of the grid: 0.55 to 1.8; by hand."""
    starts: int = 4
    """Tops of the grid that a local search begins from; by hand."""
    sigmas: tuple[float, float] = (0.05, 0.02)
    """Widths of a vote, in r: the first finds a peak, the second refines and compares it. Section 1; by hand."""
    own_sigma_range: tuple[float, float] = (0.005, 0.02)
    """Bounds of the last width, in r, which follows the data; by hand."""
    own_sigma_factor: float = 1.5
    """That width in medians of r: half of the agreeing pairs give more than half their vote. Section 1; by hand."""
    min_agreeing: float = 2.25
    """Least effective number of agreeing pairs; any three parameters satisfy one and a half. Section 5; by hand."""
    min_support: float = 0.12
    """Least share of the votes; many pairs without a common K reach 0.06. Section 5; by hand."""
    rival_ratio: float = 1.25
    """Ratio of focals from which on K is another answer. Section 5; by hand."""
    min_margin: float = 0.5
    """Least margin over every other focal, in votes. Section 5; by hand."""
    min_margin_share: float = 0.03
    """Least margin as a share of the votes for K: many pairs may barely distinguish focals. Section 5; by hand."""
    resamples: int = 25
    """Resamples of the Bayesian bootstrap. Section "without matches"; by hand."""
    stable_sigma: float = 0.01
    """Least width of resampled fits, in r: below it they snap to single pairs; by hand."""
    rarity: float = 50.0
    """Photo sets for one whose pixels are not square, or whose photos have a camera each. Sections 1 and 6; by hand."""
    sure: float = 0.95
    """Probability above which the usual is certain, the usual one; 47 answers of `benchmarks.trouble`."""
    max_log_focal_spread: float = 0.1
    """Largest standard deviation of log f; beyond it a guess is as good a start. Section 5; by hand."""
    identified_log_focal_spread: float = 0.02
    """Largest standard deviation of log f of a known focal; beyond it the answer is an estimate. Chosen on 109 cameras
    of `benchmarks.trouble`, seeds 0 to 180, 1000 to 1035 and 2000 to 2139."""
    identified_of_many: float = 0.015
    """The same where every photo has its own focal: the worst of many is further off. Section 6; by hand."""
    safe_margin_share: float = 0.2
    """Margin, as a share of the votes, below which the focal is poorly determined (walks to the side or on one plane).
    Chosen on the same 109 cameras, section 5."""
    safe_support: float = 0.8
    """Share of all votes that K then needs: a cause of missing votes may bias the others. Chosen with it."""


class Consensus:
    """The function that the right K maximizes; `center_sigma` of the prior on (u, v) about (0, 0) may be inf."""

    def __init__(self, pairs: Pairs, center_sigma: float, weights: FloatArray | None = None) -> None:
        self.pairs = pairs
        self.center_sigma = center_sigma
        self.weights = pairs.weights if weights is None else weights
        self._packed = pairs.packed_rows

    def evaluate(self, thetas: FloatArray, sigma: float) -> FloatArray:
        """Return (N,) supports plus log-priors at (N, 4) thetas; sigma is the width of a vote, in r."""
        return np.asarray(_values(self._packed, self.weights, self.center_sigma, thetas, sigma))

    def ratios(self, theta: FloatArray) -> FloatArray:
        """Return (P,) r_i at theta."""
        return np.asarray(_ratios(self._packed, theta))

    def climb(self, start: FloatArray, free: Sequence[int], sigmas: Sequence[float]) -> tuple[FloatArray, float]:
        """Return the local maximum (4,) near a start, over the free places of theta, and its value at the last sigma.

        Nelder-Mead, because the consensus has a cusp wherever a pair is satisfied exactly. For every sigma it runs a
        second time, from the end of the first with a tenth of its steps: a simplex can stall on a ridge.
        """
        theta, value, places = start.copy(), 0.0, list(free)
        steps = np.diag(CONSENSUS.first_steps)[places]
        for sigma in sigmas:
            for scale in (1.0, 0.1):
                simplex = np.concatenate([theta[None], theta + scale * steps])
                theta, value = self._climb_once(simplex, places, sigma)
        return theta, value

    def _climb_once(self, simplex: FloatArray, places: list[int], sigma: float) -> tuple[FloatArray, float]:
        """Find a maximum by Nelder and Mead (1965) from a simplex (n + 1, 4) along n places."""
        from scipy.optimize import minimize

        theta = simplex[0].copy()

        def cost(free: FloatArray) -> float:
            theta[places] = free
            return -_value(self._packed, self.weights, self.center_sigma, theta, sigma)

        end = minimize(
            cost, simplex[0, places], method="Nelder-Mead",
            options={"initial_simplex": simplex[:, places], "xatol": 1e-5, "fatol": 1e-6, "maxiter": 300},
        )  # fmt: skip
        theta[places] = end.x
        return theta, -float(end.fun)


@kernel
def _ratios(packed: FloatArray, theta: FloatArray) -> FloatArray:
    fx, fy = np.exp(theta[0] - 0.5 * theta[3]), np.exp(theta[0] + 0.5 * theta[3])
    r = np.empty(len(packed))
    for i in range(len(packed)):
        r[i] = singular_value_ratio(packed[i], fx, fy, theta[1], theta[2])
    return r


@kernel
def _value(packed: FloatArray, weights: FloatArray, center_sigma: float, theta: FloatArray, sigma: float) -> float:
    """Return sum_i w_i exp(-r_i / sigma) plus the log-prior of the center."""
    fx, fy = np.exp(theta[0] - 0.5 * theta[3]), np.exp(theta[0] + 0.5 * theta[3])
    value = -0.5 * (theta[1] ** 2 + theta[2] ** 2) / center_sigma**2
    for i in range(len(packed)):
        value += weights[i] * np.exp(-singular_value_ratio(packed[i], fx, fy, theta[1], theta[2]) / sigma)
    return float(value)


@kernel
def _values(
    packed: FloatArray, weights: FloatArray, center_sigma: float, thetas: FloatArray, sigma: float
) -> FloatArray:
    values = np.empty(len(thetas))
    for k in range(len(thetas)):
        values[k] = _value(packed, weights, center_sigma, thetas[k], sigma)
    return values


# The search: a coarse grid over K, then local searches from its best cells (ours, in place of thesis 5.8.4).


class Peak(NamedTuple):
    """A local maximum of the consensus."""

    theta: FloatArray
    value: float
    """Support plus log-prior there, at the sigma it was climbed with last."""


class Profile(NamedTuple):
    """The best cell of the grid for every focal."""

    thetas: FloatArray
    """(G, 4), by rising focal."""
    values: FloatArray
    """(G,) support plus log-prior at the first sigma."""


def scan(consensus: Consensus, log_aspects: Sequence[float]) -> Profile:
    """Return the best cell of the grid over K for every focal."""
    focals = np.geomspace(*CONSENSUS.focal_range, CONSENSUS.focals)
    centers = np.arange(
        -CONSENSUS.center_reach, CONSENSUS.center_reach + CONSENSUS.center_step / 2, CONSENSUS.center_step
    )
    cells = np.meshgrid(np.log(focals), centers, centers, np.asarray(log_aspects), indexing="ij")
    thetas = np.stack(cells, axis=-1).reshape(CONSENSUS.focals, -1, 4)
    values = consensus.evaluate(thetas.reshape(-1, 4), CONSENSUS.sigmas[0]).reshape(CONSENSUS.focals, -1)
    best = np.argmax(values, axis=1)
    rows = np.arange(CONSENSUS.focals)
    return Profile(thetas[rows, best], values[rows, best])


def peaks(consensus: Consensus, profile: Profile, free: Sequence[int]) -> list[Peak]:
    """Return the peaks that climbing from the best local maxima of the profile reaches, highest first."""
    padded = np.concatenate([[-np.inf], profile.values, [-np.inf]])
    is_top = (padded[1:-1] >= padded[:-2]) & (padded[1:-1] >= padded[2:])
    tops = np.flatnonzero(is_top)
    starts = tops[np.argsort(-profile.values[tops], kind="stable")][: CONSENSUS.starts]
    ends = [Peak(*consensus.climb(profile.thetas[start], free, CONSENSUS.sigmas)) for start in starts]
    return sorted(ends, key=lambda peak: -peak.value)


# Evidence for a peak: the pairs that support it, its best rival, its stability.


def residual_sigma(consensus: Consensus, theta: FloatArray) -> float:
    """Return the width that fits the scatter of the agreeing pairs: 1.5 times the weighted median of their r."""
    r = consensus.ratios(theta)
    agreeing = r < CONSENSUS.sigmas[0]
    if not np.any(agreeing):
        return CONSENSUS.own_sigma_range[1]
    order = np.argsort(r[agreeing], kind="stable")
    mass = np.cumsum(consensus.weights[agreeing][order])
    median = r[agreeing][order][np.searchsorted(mass, 0.5 * mass[-1])]
    return float(np.clip(CONSENSUS.own_sigma_factor * median, *CONSENSUS.own_sigma_range))


def votes(consensus: Consensus, theta: FloatArray, sigma: float) -> FloatArray:
    """Return (P,) votes of the pairs for theta: w_i exp(-r_i / sigma)."""
    return np.asarray(consensus.weights * np.exp(-consensus.ratios(theta) / sigma))


def effective_count(votes: FloatArray) -> float:
    """Return the effective number of votes (Kish's effective sample size); 0 for no votes."""
    total, squares = float(np.sum(votes)), float(np.sum(votes**2))
    return total * total / squares if squares > 0 else 0.0


def support_reason(votes: FloatArray, weights: FloatArray) -> str:
    """Return why the votes (P,) do not suffice for a camera, beside the weights (P,); empty where they do."""
    count, support = effective_count(votes), float(np.sum(votes) / np.sum(weights))
    if count >= CONSENSUS.min_agreeing and support >= CONSENSUS.min_support:
        return ""
    return f"the pairs do not agree on a camera: {100 * support:.0f} % of the votes, or {count:.1f} effective pairs"


def ambiguity_reason(margin: float, votes: FloatArray) -> str:
    """Return why a margin over the best rival is not enough beside the votes (P,); empty where it is."""
    if margin >= max(CONSENSUS.min_margin, CONSENSUS.min_margin_share * float(np.sum(votes))):
        return ""
    return "the pairs fit other focals as well or better (too little rotation, parallel axes, or an orbit)"


def best_rival(
    consensus: Consensus,
    theta: FloatArray,
    free: Sequence[int],
    sigmas: Sequence[float],
    profile: Profile | None = None,
) -> float:
    """Return the highest value, at the last sigma, of a focal `rival_ratio` away with all other free places adapted.

    The climbs start from theta and, given a profile, from its cell for that focal. Where the consensus does not depend
    on the focal (orbits, parallel axes) the rival equals the value at theta.
    """
    adapted = [index for index in free if index != LOG_FOCAL]
    values = []
    for log_focal in theta[LOG_FOCAL] + np.log(CONSENSUS.rival_ratio) * np.array([-1.0, 1.0]):
        starts = [theta.copy()]
        if profile is not None:
            starts.append(profile.thetas[np.argmin(np.abs(profile.thetas[:, LOG_FOCAL] - log_focal))].copy())
        for start in starts:
            start[LOG_FOCAL] = log_focal
            values.append(consensus.climb(start, adapted, sigmas)[1])
    return max(values)


def resample_peak(consensus: Consensus, theta: FloatArray, free: Sequence[int], sigma: float, seed: int) -> FloatArray:
    """Return the peaks (B, 4) of the Bayesian bootstrap (Rubin 1981): few pairs drawn again would often be one."""
    rng = np.random.default_rng(seed)
    weights = consensus.weights
    thetas = []
    for _ in range(CONSENSUS.resamples):
        drawn = weights * rng.exponential(size=len(weights))
        drawn *= np.sum(weights) / np.sum(drawn)
        resampled = Consensus(consensus.pairs, consensus.center_sigma, drawn)
        thetas.append(resampled.climb(theta, free, (max(sigma, CONSENSUS.stable_sigma),))[0])
    return np.array(thetas)


def deviation(values: FloatArray, count: float, parameters: int) -> float:
    """Return the standard deviation over resampled peaks (B,), corrected for the freedom of `count` pairs."""
    freedom = max(count - 0.5 * parameters, 0.5)
    return float(np.std(values, ddof=1) * np.sqrt(max(count, 1.0) / freedom))


def spread_px(thetas: FloatArray, unit_px: float, count: float, parameters: int) -> dict[str, float]:
    """Return the standard deviations of fx, fy, cx, cy in pixels over (B, 4) resampled thetas, see `deviation`."""
    focal, half = np.exp(thetas[:, LOG_FOCAL]) * unit_px, np.exp(0.5 * thetas[:, LOG_ASPECT])
    columns = {"fx": focal / half, "fy": focal * half}
    columns |= {"cx": thetas[:, CENTER_U] * unit_px, "cy": thetas[:, CENTER_V] * unit_px}
    return {name: deviation(column, count, parameters) for name, column in columns.items()}


@dataclass(frozen=True, slots=True, eq=False)
class ConsensusPeak:
    """A peak with everything that a verdict needs."""

    theta: FloatArray
    """(4,) log f, u, v, log a."""
    free: tuple[int, ...]
    """Places in theta that were free."""
    sigma: float
    """Width of the consensus that fits the agreeing pairs."""
    margin: float
    """Votes for it beyond those for any other focal."""
    votes: FloatArray
    """(P,) votes of the pairs for it."""
    gain: float
    """Votes that freeing fy/fx wins."""
    rivals: tuple[FloatArray, ...]
    """(4,) each: lower peaks at other focals, highest first."""

    @property
    def aspect_reason(self) -> str:
        """Why square pixels make the answer an estimate; empty where they do not."""
        doubtful = LOG_ASPECT not in self.free and self.gain >= np.log(CONSENSUS.rarity * (1.0 - CONSENSUS.sure))
        return "the pixels may not be square" if doubtful else ""

    def rival_reason(self, weights: FloatArray) -> str:
        """Return why the answer to pairs of weights (P,) is an estimate despite a small deviation; empty for none."""
        mass = float(np.sum(self.votes))
        doubtful = self.margin < CONSENSUS.safe_margin_share * mass and mass < CONSENSUS.safe_support * float(
            np.sum(weights)
        )
        return "many pairs fit other focals nearly as well; some pairs fit none" if doubtful else ""

    def evidence(self, weights: FloatArray) -> dict[str, float]:
        """Return figures for the report, by name."""
        mass = float(np.sum(self.votes))
        return {
            "support": mass / float(np.sum(weights)),
            "agreeing_pairs": effective_count(self.votes),
            "lead": self.margin,
            "lead_share": self.margin / mass if mass > 0 else 0.0,
            "sigma": self.sigma,
            "aspect_gain": self.gain,
        }

    def undetermined_reason(self, weights: FloatArray) -> str:
        """Return why pairs of weights (P,) do not determine a camera; empty where they do."""
        return support_reason(self.votes, weights) or ambiguity_reason(self.margin, self.votes)


def find_peak(consensus: Consensus) -> ConsensusPeak:
    """Find the highest peak with square pixels or, where the pairs clearly support it, with any aspect."""
    profile = scan(consensus, (0.0,))
    square = peaks(consensus, profile, SQUARE_PIXELS)
    free_profile = scan(consensus, CONSENSUS.log_aspects)
    free = peaks(consensus, free_profile, ANY_PIXELS)
    # both use the width that fits the freer one: a wrong square answer would choose a lenient width
    sigmas = (residual_sigma(consensus, free[0].theta),)
    theta, value = consensus.climb(square[0].theta, SQUARE_PIXELS, sigmas)
    gain = max(consensus.climb(start, ANY_PIXELS, sigmas)[1] for start in (theta, free[0].theta)) - value
    if gain >= np.log(CONSENSUS.rarity):
        return _examine(consensus, free, free_profile, ANY_PIXELS, gain)
    return _examine(consensus, square, profile, SQUARE_PIXELS, gain)


def _examine(
    consensus: Consensus, ends: list[Peak], profile: Profile, free: tuple[int, ...], gain: float
) -> ConsensusPeak:
    """Refine the highest peak with the width that fits its pairs, and collect the evidence for it."""
    best = ends[0]
    sigma = residual_sigma(consensus, best.theta)
    theta, _ = consensus.climb(best.theta, free, (sigma,))
    value = float(consensus.evaluate(theta[None, :], CONSENSUS.sigmas[-1])[0])
    far = [peak for peak in ends[1:] if abs(peak.theta[LOG_FOCAL] - theta[LOG_FOCAL]) > np.log(CONSENSUS.rival_ratio)]
    margin = value - max([best_rival(consensus, theta, free, CONSENSUS.sigmas, profile), *(peak.value for peak in far)])
    cast = votes(consensus, theta, CONSENSUS.sigmas[-1])
    return ConsensusPeak(theta, free, sigma, margin, cast, gain, tuple(peak.theta for peak in far))


def uncertainty_reason(log_focal_spread: float, *, one_of_many: bool = False) -> str:
    """Return why an accepted answer is only an estimate; empty if identifiable. One of many needs a smaller spread."""
    vague = log_focal_spread > (CONSENSUS.identified_of_many if one_of_many else CONSENSUS.identified_log_focal_spread)
    return f"the focal is uncertain by {100 * log_focal_spread:.0f} %" if vague else ""


def rejection_reason(theta: FloatArray, log_focal_spread: float, size: tuple[int, int]) -> str:
    """Return why an agreed answer, log f, u, v, ... in longer sides from the middle, is rejected; or nothing."""
    focal, (low, high) = float(np.exp(theta[LOG_FOCAL])), CONSENSUS.focal_range
    half_step = (high / low) ** (0.5 / (CONSENSUS.focals - 1))
    if not low * half_step < focal < high / half_step:
        return f"the focal is at the end of the range: {focal:.2f} times the longer side"
    if np.any(np.abs(theta[CENTER_U : CENTER_V + 1]) > 0.5 * np.array(size) / max(size)):
        return "the optical center lies outside the photo"
    if log_focal_spread > CONSENSUS.max_log_focal_spread:
        return f"the focal is uncertain by {100 * log_focal_spread:.0f} %"
    return ""
