"""The K that most pairs agree on: the highest peak of the joint consensus, and the evidence for and against it.

Thesis 5.8.4 extended from a plane to all of K; the evidence is ours.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from sfm_app.jit import kernel
from sfm_app.selfcal.constraints import singular_value_ratio
from sfm_app.selfcal.pairs import Pairs
from sfm_app.types.arrays import FloatArray

# The consensus of all pairs over all of K at once.
#
# Thesis (5.33) seeks the point where most zero curves meet, in one plane of K at a time. Here all of K is searched
# at once: at the parameters ``theta = (log f, u, v, log a)``, with f = sqrt(fx fy) and a = fy / fx, how many pairs
# satisfy the constraint? Each pair votes with at most its weight, so that outliers have little influence::
#
# support(theta) = sum_i w_i exp(-r_i(theta) / sigma), r = (s1 - s2) / (s1 + s2) of E_i = K'F_iK
#
# A vote is taken as a log-likelihood, to which a log-prior on the center is added: the prior decides where pairs
# are few and fades where they are many.

LOG_FOCAL, CENTER_U, CENTER_V, LOG_ASPECT = range(4)
"""Places in theta."""
FIRST_STEPS = np.array([0.05, 0.03, 0.03, 0.05])
"""First steps of the local search along theta. Chosen by hand; halved and doubled by `benchmarks.sensitivity`."""
FINISHED_STEP, FINISHED_VALUE = 1e-5, 1e-6
"""A simplex of this extent in theta and in value has converged. Chosen by hand; halved and doubled by
`benchmarks.sensitivity`."""
MOST_STEPS = 300
"""Most steps of a simplex. Chosen by hand; halved and doubled by `benchmarks.sensitivity`."""


class Consensus:
    """The function that the right K maximizes.

    Args:
        pairs: the pairs that vote.
        center_sigma: standard deviation of the prior on (u, v) about (0, 0), in units of the pairs; may be inf.
        weights: (P,) to use instead of those of the pairs.
    """

    def __init__(self, pairs: Pairs, center_sigma: float, weights: FloatArray | None = None) -> None:
        self.pairs = pairs
        self.center_sigma = center_sigma
        self.weights = pairs.weights if weights is None else weights
        self._packed = pairs.packed_rows

    def with_weights(self, weights: FloatArray) -> "Consensus":
        """Return the consensus of the same pairs with other weights (P,)."""
        return Consensus(self.pairs, self.center_sigma, weights)

    def evaluate(self, thetas: FloatArray, sigma: float) -> FloatArray:
        """Return (N,) supports plus log-priors at `thetas`.

        Args:
            thetas: (N, 4) parameters of K.
            sigma: width of a vote, in units of r, > 0.
        """
        return np.asarray(_values(self._packed, self.weights, self.center_sigma, thetas, sigma))

    def ratios(self, theta: FloatArray) -> FloatArray:
        """Return (P,) r_i at theta."""
        return np.asarray(_ratios(self._packed, theta))

    def climb(self, start: FloatArray, free: Sequence[int], sigmas: Sequence[float]) -> tuple[FloatArray, float]:
        """Return the local maximum reached from a start by moving some entries of theta, through falling sigmas.

        Nelder-Mead, because the consensus has a cusp wherever a pair is satisfied exactly. For every sigma it runs a
        second time, from the end of the first with a tenth of its steps: a simplex can stall on a ridge.

        Args:
            start: (4,) theta to begin at.
            free: places in theta that may move.
            sigmas: falling widths of a vote, at least one.

        Returns:
            theta (4,) and the value there, at the last sigma.
        """
        theta, value = start.copy(), 0.0
        for sigma in sigmas:
            for steps in (FIRST_STEPS, 0.1 * FIRST_STEPS):
                simplex = np.tile(theta, (len(free) + 1, 1))
                for row, index in enumerate(free):
                    simplex[row + 1, index] += steps[index]
                theta, value = _climb(self._packed, self.weights, self.center_sigma, simplex, sigma)
        return theta, value


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


@kernel
def _climb(
    packed: FloatArray, weights: FloatArray, center_sigma: float, simplex: FloatArray, sigma: float
) -> tuple[FloatArray, float]:
    """Find a maximum by Nelder and Mead (1965) from a simplex (n + 1, 4), with their coefficients 1, 2, 1/2, 1/2."""
    count = len(simplex)
    values = _values(packed, weights, center_sigma, simplex, sigma)
    for _ in range(MOST_STEPS):
        _sort(simplex, values)
        if values[0] - values[-1] <= FINISHED_VALUE and _extent(simplex) <= FINISHED_STEP:
            break
        worst = values[-1]
        trial = _reflect(simplex, 1.0)
        value = _value(packed, weights, center_sigma, trial, sigma)
        if value > values[0]:
            further = _reflect(simplex, 2.0)
            better = _value(packed, weights, center_sigma, further, sigma)
            if better > value:
                trial, value = further, better
        elif value <= values[-2]:
            floor = max(value, worst)
            trial = _reflect(simplex, 0.5 if value > worst else -0.5)
            value = _value(packed, weights, center_sigma, trial, sigma)
            if value <= floor:
                for k in range(1, count):
                    for column in range(4):
                        simplex[k, column] = 0.5 * (simplex[0, column] + simplex[k, column])
                    values[k] = _value(packed, weights, center_sigma, simplex[k], sigma)
                continue
        _copy(trial, simplex[-1])
        values[-1] = value
    _sort(simplex, values)
    return simplex[0].copy(), float(values[0])


@kernel
def _sort(simplex: FloatArray, values: FloatArray) -> None:
    """Sort in place, highest first; equal values keep their order. Loops compile in a tenth of the time of argsort."""
    for k in range(1, len(values)):
        row, value = simplex[k].copy(), values[k]
        i = k
        while i > 0 and values[i - 1] < value:
            _copy(simplex[i - 1], simplex[i])
            values[i] = values[i - 1]
            i -= 1
        _copy(row, simplex[i])
        values[i] = value


@kernel
def _copy(row: FloatArray, place: FloatArray) -> None:
    """Write the entries of a row to a place; assigning rows compiles for a second and a half."""
    for column in range(4):
        place[column] = row[column]


@kernel
def _reflect(simplex: FloatArray, factor: float) -> FloatArray:
    """Return the last corner reflected at the centroid of the others, its distance scaled by `factor`."""
    trial = np.empty(4)
    for column in range(4):
        middle = 0.0
        for k in range(len(simplex) - 1):
            middle += simplex[k, column]
        middle /= len(simplex) - 1
        trial[column] = middle + factor * (middle - simplex[-1, column])
    return trial


@kernel
def _extent(simplex: FloatArray) -> float:
    extent = 0.0
    for k in range(1, len(simplex)):
        for column in range(4):
            extent = max(extent, abs(simplex[k, column] - simplex[0, column]))
    return extent


# The highest peak of the joint consensus: a coarse grid over K, then local searches from its best cells.
#
# Ours, in place of the search along zero curves of thesis 5.8.4 (Eq. 5.33).

FOCAL_RANGE = (0.3, 5.0)
"""Focals that are tried, in units of the longer side: 118 to 11 degrees of view. docs/algorithms.md, Self-calibration,
5. Chosen by hand; halved and doubled by `benchmarks.sensitivity`."""
FOCALS = 29
"""Focals on the grid, each 10 % above the one before. Chosen by hand; halved and doubled by
`benchmarks.sensitivity`."""
CENTER_REACH = 0.4
"""Centers are tried up to this far from the middle, in units of the longer side. Chosen by hand; halved and doubled by
`benchmarks.sensitivity`."""
CENTER_STEP = 0.08
"""Between centers on the grid, in the same units. Chosen by hand; halved and doubled by `benchmarks.sensitivity`."""
SIGMAS = (0.05, 0.02)
"""Widths of the consensus, in units of r: the first finds a peak, the second refines it and compares it with others.
docs/algorithms.md, Self-calibration, 1. Chosen by hand; halved and doubled by `benchmarks.sensitivity`."""
MOST_STARTS = 4
"""Tops of the grid that a local search begins from. Chosen by hand; halved and doubled by `benchmarks.sensitivity`."""


class Peak(NamedTuple):
    """A local maximum of the consensus."""

    theta: FloatArray
    """(4,) log f, u, v, log a."""
    value: float
    """Support plus log-prior there, at the sigma it was climbed with last."""


class Profile(NamedTuple):
    """The best cell of the grid for every focal."""

    thetas: FloatArray
    """(FOCALS, 4), by rising focal."""
    values: FloatArray
    """(FOCALS,) support plus log-prior at the first of `SIGMAS`."""


def scan(consensus: Consensus, log_aspects: Sequence[float]) -> Profile:
    """Find the best cell of the grid over K for every focal.

    Args:
        consensus: of all pairs.
        log_aspects: log fy/fx of the grid.
    """
    focals = np.geomspace(*FOCAL_RANGE, FOCALS)
    centers = np.arange(-CENTER_REACH, CENTER_REACH + CENTER_STEP / 2, CENTER_STEP)
    cells = np.meshgrid(np.log(focals), centers, centers, np.asarray(log_aspects), indexing="ij")
    thetas = np.stack(cells, axis=-1).reshape(FOCALS, -1, 4)
    values = consensus.evaluate(thetas.reshape(-1, 4), SIGMAS[0]).reshape(FOCALS, -1)
    best = np.argmax(values, axis=1)
    rows = np.arange(FOCALS)
    return Profile(thetas[rows, best], values[rows, best])


def peaks(consensus: Consensus, profile: Profile, free: Sequence[int]) -> list[Peak]:
    """Return the peaks reached by climbing from the best local maxima of the profile, highest first.

    Args:
        consensus: of all pairs.
        profile: from `scan`.
        free: places in theta that may move.
    """
    padded = np.concatenate([[-np.inf], profile.values, [-np.inf]])
    is_top = (padded[1:-1] >= padded[:-2]) & (padded[1:-1] >= padded[2:])
    tops = np.flatnonzero(is_top)
    starts = tops[np.argsort(-profile.values[tops], kind="stable")][:MOST_STARTS]
    ends = [Peak(*consensus.climb(profile.thetas[start], free, SIGMAS)) for start in starts]
    return sorted(ends, key=lambda peak: -peak.value)


# Evidence for a peak of the joint consensus: how many pairs support it, its best rival, its stability.
#
# Ours; the bootstrap is Rubin's (1981), the effective sample size Kish's (1965).

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


SQUARE_PIXELS = (LOG_FOCAL, CENTER_U, CENTER_V)
"""Places in theta that are sought when pixels are square."""
ANY_PIXELS = (*SQUARE_PIXELS, LOG_ASPECT)
"""Places in theta that are sought when they need not be."""
LOG_ASPECTS = tuple(np.linspace(-0.6, 0.6, 9))
"""log fy/fx on the grid: 0.55 to 1.8. Chosen by hand; halved and doubled by `benchmarks.sensitivity`."""
ASPECT_GAIN = float(np.log(50))
"""Votes that freeing fy/fx must win: about one photo set in fifty has pixels that are not square. docs/algorithms.md,
Self-calibration, 1. Chosen by hand; halved and doubled by `benchmarks.sensitivity`."""
PERHAPS_ASPECT_GAIN = float(np.log(50 * 0.05))
"""Votes from which on square pixels are less than 95 % sure. Of 47 answers with square pixels on the photo sets and on
folders 0 to 170 of `python -m benchmarks.trouble`, one had more (1.55), and its pixels were not square."""
MAX_LOG_FOCAL_SPREAD = 0.1
"""Largest standard deviation of log f: a focal that is less certain starts bundle adjustment no better than a guess.
docs/algorithms.md, Self-calibration, 5. Chosen by hand; halved and doubled by `benchmarks.sensitivity`."""
IDENTIFIED_LOG_FOCAL_SPREAD = 0.02
"""Largest standard deviation of log f that counts as known: with 0.025 one focal of twenty is off by 5 %, which is too
much to be called identifiable. Between this and the limit above the answer is an estimate: a better start than a guess,
and no more. Of 109 cameras of seeds 0 to 180, 1000 to 1035 and 2000 to 2139 of `python -m benchmarks.trouble` four lie
between 0.02 and 0.03: off by 10, 7, 2 and 1 %."""
SAFE_LEAD_SHARE, SAFE_SUPPORT = 0.2, 0.8
"""Where a focal a quarter away loses less than the first share of the votes (walks to the side or on one plane), the
focal is poorly determined. Then pairs must win the second share of all votes: what misled the missing ones may have
biased the others. Of the same 109 cameras eight are short of both: off by 43, 10, 6, 4, 4, 1, 0.3 and 0.2 %; no other
of them whose deviation is below 0.02 is off by more than 2.5 %. docs/algorithms.md, Self-calibration, 5."""
IDENTIFIED_OF_MANY = 0.015
"""Largest such deviation where every photo has its own focal: the worst of many is further off than a single one.
docs/algorithms.md, Self-calibration, 6. Chosen by hand; halved and doubled by `benchmarks.sensitivity`."""
EDGE = 1.02
"""A focal within this factor of an end of the range counts as having run to that end. Chosen by hand; halved and
doubled by `benchmarks.sensitivity`."""


@dataclass(frozen=True, slots=True, eq=False)
class Answer:
    """A peak with everything that a verdict needs."""

    theta: FloatArray
    """(4,) log f, u, v, log a."""
    free: tuple[int, ...]
    """Places in theta that were sought."""
    sigma: float
    """Width of the consensus that fits the agreeing pairs."""
    lead: float
    """Votes by which it leads every other focal."""
    votes: FloatArray
    """(P,) votes of the pairs for it."""
    gain: float
    """Votes that freeing fy/fx wins."""
    others: tuple[FloatArray, ...]
    """(4,) each: lower peaks, highest first."""

    @property
    def doubt_of_pixels(self) -> str:
        """Why an answer with square pixels is only an estimate; empty where it is not."""
        doubtful = LOG_ASPECT not in self.free and self.gain >= PERHAPS_ASPECT_GAIN
        return "its pixels may not be square" if doubtful else ""

    def doubt_of_focal(self, weights: FloatArray) -> str:
        """Return why an answer to pairs of weights (P,) is an estimate despite a small deviation; empty for none."""
        mass = float(np.sum(self.votes))
        doubtful = self.lead < SAFE_LEAD_SHARE * mass and mass < SAFE_SUPPORT * float(np.sum(weights))
        return "many pairs fit other focals nearly as well, and some fit none" if doubtful else ""

    def evidence(self, weights: FloatArray) -> dict[str, float]:
        """Return figures for the report, by name."""
        mass = float(np.sum(self.votes))
        return {
            "support": mass / float(np.sum(weights)),
            "agreeing_pairs": effective_count(self.votes),
            "lead": self.lead,
            "lead_share": self.lead / mass if mass > 0 else 0.0,
            "sigma": self.sigma,
            "aspect_gain": self.gain,
        }

    def contradiction(self, weights: FloatArray) -> str:
        """Return why pairs of the given weights (P,) do not determine a camera; empty where they do."""
        return disagreement(self.votes, weights) or indecision(self.lead, self.votes)

    def resample(self, consensus: Consensus, seed: int) -> FloatArray:
        """Return (B, 4) the peak under resampled pairs, see `peak_evidence.resample_peak`.

        Args:
            consensus: of all pairs.
            seed: same seed, same result.
        """
        return resample_peak(consensus, self.theta, self.free, self.sigma, seed)

    def deviation(self, values: FloatArray) -> float:
        """Return the standard deviation of an entry of theta from its resampled `values` (B,)."""
        return deviation(values, effective_count(self.votes), len(self.free))


def find_peak(consensus: Consensus) -> Answer:
    """Find the highest peak with square pixels or, where the pairs clearly support it, with any aspect."""
    profile = scan(consensus, (0.0,))
    square = peaks(consensus, profile, SQUARE_PIXELS)
    free_profile = scan(consensus, LOG_ASPECTS)
    free = peaks(consensus, free_profile, ANY_PIXELS)
    # both use the width that fits the freer one: a wrong square answer would choose a lenient width
    sigmas = (residual_sigma(consensus, free[0].theta),)
    theta, value = consensus.climb(square[0].theta, SQUARE_PIXELS, sigmas)
    gain = max(consensus.climb(start, ANY_PIXELS, sigmas)[1] for start in (theta, free[0].theta)) - value
    if gain >= ASPECT_GAIN:
        return _examine(consensus, free, free_profile, ANY_PIXELS, gain)
    return _examine(consensus, square, profile, SQUARE_PIXELS, gain)


def _examine(consensus: Consensus, ends: list[Peak], profile: Profile, free: tuple[int, ...], gain: float) -> Answer:
    """Refine the highest peak with the width that fits its pairs, and collect the evidence for it."""
    best = ends[0]
    sigma = residual_sigma(consensus, best.theta)
    theta, _ = consensus.climb(best.theta, free, (sigma,))
    value = float(consensus.evaluate(theta[None, :], SIGMAS[-1])[0])
    far = [peak for peak in ends[1:] if abs(peak.theta[LOG_FOCAL] - theta[LOG_FOCAL]) > np.log(RIVAL_RATIO)]
    lead = value - max([best_rival(consensus, theta, free, SIGMAS, profile), *(peak.value for peak in far)])
    given = votes(consensus, theta, SIGMAS[-1])
    return Answer(theta, free, sigma, lead, given, gain, tuple(peak.theta for peak in far))


def vagueness(log_focal_spread: float, *, one_of_many: bool = False) -> str:
    """Return why an answer without objections is only an estimate; empty where it is identifiable.

    Args:
        log_focal_spread: standard deviation of log f.
        one_of_many: whether every photo has a focal of its own; a smaller spread is required then.
    """
    vague = log_focal_spread > (IDENTIFIED_OF_MANY if one_of_many else IDENTIFIED_LOG_FOCAL_SPREAD)
    return f"the focal is uncertain by {100 * log_focal_spread:.0f} %" if vague else ""


def objection(theta: FloatArray, log_focal_spread: float, half_size: tuple[float, float]) -> str:
    """Return why an answer that the pairs agree on is not trusted; empty where it is.

    Args:
        theta: log f, u, v, ... in longer sides from the middle.
        log_focal_spread: standard deviation of log f.
        half_size: half of the photo's width and height in longer sides.
    """
    focal, (low, high) = float(np.exp(theta[LOG_FOCAL])), FOCAL_RANGE
    if not low * EDGE < focal < high / EDGE:
        return f"the focal runs to the end of the range, {focal:.2f} longer sides"
    if np.any(np.abs(theta[CENTER_U : CENTER_V + 1]) > half_size):
        return "the optical center runs out of the photo"
    if log_focal_spread > MAX_LOG_FOCAL_SPREAD:
        return f"the focal is uncertain by {100 * log_focal_spread:.0f} %"
    return ""
