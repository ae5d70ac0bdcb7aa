"""Photos of one size: of one camera, of two, or each of its own.

Ours, on the constraint of thesis 5.2.4; the thesis leaves several peaks of the consensus (Figure 5.15) undone. A pair
of weight w with the residual r under two focals has the log-likelihood w log(1 + exp(-r / s) / s), up to a constant:
r is exponential with mean s for a right pair, and uniform on [0, 1] for a wrong one. Focals are fitted to four fifths
of the pairs and predict the rest.
"""

from collections.abc import Iterable, Mapping, Sequence
from itertools import chain
from math import lgamma
from typing import NamedTuple

import numpy as np

from sfm_app.selfcal.consensus import CONSENSUS, Consensus, find_peak
from sfm_app.selfcal.groups import VoteTables, consensus_places, log_focal_grid
from sfm_app.selfcal.pairs import LOG_FOCAL
from sfm_app.selfcal.priors import PRIORS
from sfm_app.types import PairId
from sfm_app.types.arrays import FloatArray, IndexArray


class DIVISION:
    """Comparison of hypotheses. Section 6 of docs/algorithms/zero-curves.md."""

    focals: int = 81
    """Focals on the grid, 3.5 % apart; by hand."""
    sigma: float = 0.03
    """Mean residual r of right pairs: focals that are neighbors on the grid still fit; by hand."""
    most_pairs: int = 500
    """Most pairs that are compared: a table takes 50 kB a pair; by hand."""
    folds: int = 5
    """Parts of the pairs that are held out in turn; by hand."""
    max_remaining_share: float = 0.5
    """Share of the unexplained likelihood that more cameras may leave: right ones leave 0.15 to 0.37. Section 6."""


class Division(NamedTuple):
    """The cameras of photos of one size."""

    labels: dict[int, int]
    """Number of the camera by photo, for photos that have pairs."""
    cameras: FloatArray
    """(C, 5)."""
    is_doubtful: bool
    """Whether there may be more cameras."""

    @property
    def is_camera_per_photo(self) -> bool:
        """Whether each of several photos has its own camera."""
        return 1 < len(self.labels) == len(self.cameras)


def peak_cameras(consensus: Consensus) -> list[FloatArray]:
    """Return the peaks of the consensus as cameras (5,) without distortion, highest first."""
    peak = find_peak(consensus)
    return [np.append(theta, 0.0) for theta in (peak.theta, *peak.rivals)]


def divide_photos(
    tables: VoteTables, photos: Sequence[PairId], starts: Sequence[FloatArray], seed: int,
    known: Mapping[int, int] | None = None, *, mixed: bool = False,
) -> Division:  # fmt: skip
    """Divide photos of one size among cameras that share all but the focal.

    The tables are of undistorted pairs, in longer sides from the middle of the photo; their members are not used. The
    starts (5,) give center and aspect, and the usual ones are another start. The seed divides the pairs into folds.
    `known` cameras by photo are compared with a camera per photo, in place of one camera and two. In a `mixed` folder,
    photos of other sizes have a camera each: here this is as likely as not, and need not explain pairs of look-alikes.
    """
    rows = np.linspace(0, len(photos) - 1, min(len(photos), DIVISION.most_pairs)).astype(np.int64)
    everyone = sorted({photo for pair in photos for photo in pair})
    members = np.searchsorted(everyone, np.array(photos, np.int64).reshape(-1, 2))
    few = np.unique([known[photo] if known else 0 for photo in everyone], return_inverse=True)[1].astype(np.int64)
    usual = FocalGrid(tables, rows, np.zeros(5), members)
    others = (FocalGrid(tables, rows, theta, members) for theta in starts)
    shared = max(chain([usual], others), key=lambda grid: grid.fit(few))
    fold = np.random.default_rng(seed).permutation(len(rows)) % DIVISION.folds
    two, own = few if known else shared.two_cameras(), np.arange(len(everyone))
    hypotheses = (
        (two, log_probability(two) - log_probability(few), DIVISION.max_remaining_share),
        (own, 0.0, 1.0) if mixed else (own, -float(np.log(CONSENSUS.rarity)), DIVISION.max_remaining_share),
    )
    labels, is_doubtful = _choose(few, hypotheses, {shared, usual}, fold)
    return Division(dict(zip(everyone, labels.tolist(), strict=True)), shared.cameras(labels), is_doubtful)


def _choose(
    labels: IndexArray, hypotheses: Iterable[tuple[IndexArray, float, float]], grids: "set[FocalGrid]", fold: IndexArray
) -> tuple[IndexArray, bool]:
    """Return the most probable cameras (N,), and whether more are possible.

    A hypothesis has its log-prior odds, and the share of the unexplained likelihood that it may leave. A focal of
    its own also absorbs errors that the pairs of a photo share: more cameras must explain most of the rest.
    """
    is_doubtful, doubt = False, float(np.log(1.0 - CONSENSUS.sure))
    most = next(iter(grids)).most
    for more, log_prior, max_remaining_share in hypotheses:
        before, after = (max(grid.fit(one) for grid in grids) for one in (labels, more))
        # a gain that is missing on the fitted pairs will not appear on those held out
        if after - before + log_prior <= doubt or np.array_equal(more, labels):
            continue
        before, after = (max(grid.held_out(one, fold) for grid in grids) for one in (labels, more))
        if most - after > max_remaining_share * (most - before):
            continue
        log_odds = after - before + log_prior
        is_doubtful = log_odds <= 0.0 and (is_doubtful or log_odds > doubt)
        labels = more if log_odds > 0.0 else labels
    return labels, is_doubtful


def log_probability(labels: IndexArray) -> float:
    """Return the log-probability of cameras of photos (N,) before any pair (Ewens 1972, with the parameter 1)."""
    counts = np.bincount(labels)
    return sum(map(lgamma, counts[counts > 0].tolist())) - lgamma(len(labels) + 1)


class FocalGrid:
    """Log-likelihoods of undistorted pairs for the focals of their two photos, on a common grid.

    `rows` (P,) count; `theta` (5,) has the center and aspect of all photos; `members` (Q, 2) are the photos of all
    pairs, from 0.
    """

    def __init__(self, tables: VoteTables, rows: IndexArray, theta: FloatArray, members: IndexArray) -> None:
        self.count = int(np.max(members, initial=-1)) + 1
        self.members, self.grid = members[rows], log_focal_grid(DIVISION.focals)
        self.trials = np.repeat(theta[None], DIVISION.focals, axis=0)
        self.trials[:, LOG_FOCAL] = self.grid
        self.trials[:, -1] = 0.0
        self.rows, sigma = np.arange(len(rows)), DIVISION.sigma
        votes = [tables.votes(int(row), self.trials, self.trials, sigma) / tables.weights[row] for row in rows]
        shape = (len(rows), DIVISION.focals, DIVISION.focals)
        self.gains = tables.weights[rows][:, None, None] * np.log1p(np.reshape(votes, shape) / sigma)
        """(P, G, G)."""
        self.most = float(np.sum(tables.weights[rows]) * np.log1p(1.0 / sigma))  # where all pairs fit exactly

    def places(self, labels: IndexArray, rows: IndexArray) -> IndexArray:
        """Return (C,) grid indices of the focals on which the pairs `rows` agree, given the camera of each photo."""
        usual = ((self.grid - PRIORS.usual_log_focal) / PRIORS.focal_spread) ** 2
        one = np.einsum("pgg->g", self.gains[rows]) - 0.5 * usual
        priors = -0.5 * ((self.grid - self.grid[np.argmax(one)]) / PRIORS.family_spread) ** 2
        if not np.any(labels):
            return np.array([np.argmax(one)])
        own = np.tile(priors, (int(np.max(labels)) + 1, 1))
        return consensus_places(own, ((*labels[self.members[row]], self.gains[row]) for row in rows))

    def cameras(self, labels: IndexArray) -> FloatArray:
        """Return (C, 5) cameras with the focals on which all pairs agree."""
        return np.asarray(self.trials[self.places(labels, self.rows)], np.float64)

    def fit(self, labels: IndexArray) -> float:
        """Return the log-likelihood of all pairs for the focals on which they agree, given the camera of each photo."""
        return float(np.sum(self._pair_gains(self.places(labels, self.rows)[labels], self.rows)))

    def held_out(self, labels: IndexArray, fold: IndexArray) -> float:
        """Return the log-likelihood of all pairs, each for the focals on which the other folds of (P,) agree."""
        total = 0.0
        for number in np.unique(fold):
            places = self.places(labels, np.flatnonzero(fold != number))
            total += float(np.sum(self._pair_gains(places[labels], np.flatnonzero(fold == number))))
        return total

    def two_cameras(self) -> IndexArray:
        """Return (N,) which of two cameras each photo has; all 0 if one camera is more probable.

        A minority that agrees on another focal cannot be found one photo at a time: a photo that changes alone
        disagrees with the rest of its group. So each photo first has its own focal; photos with a shorter one than each
        of these form one camera. Every photo in turn then takes its better camera.
        """
        own = self.places(np.arange(self.count), self.rows)
        best = one = np.zeros(self.count, np.int64)
        most = self.fit(one) + log_probability(one)
        for cut in np.unique(own)[1:]:
            labels = self.assign(self.places(start := (own < cut).astype(np.int64), self.rows), start)
            while np.ptp(labels) and (value := self.fit(labels) + log_probability(labels)) > most:
                best, most = labels, value
                labels = self.assign(self.places(labels, self.rows), labels)
        return best

    def assign(self, places: IndexArray, labels: IndexArray) -> IndexArray:
        """Give every photo in turn the more probable of two cameras, until none changes."""
        # both directions of every pair, by the photo that they begin with
        ends = np.concatenate([self.members, self.members[:, ::-1]])
        order = np.argsort(ends[:, 0], kind="stable")
        gains = self.gains[:, places[:, None], places]
        gains = np.concatenate([gains, gains.transpose(0, 2, 1)])[order]
        starts, neighbors = np.searchsorted(ends[order, 0], np.arange(len(labels) + 1)), ends[order, 1]
        labels, changed = labels.copy(), True
        while changed:
            changed = False
            for photo in range(len(labels)):
                own = np.arange(starts[photo], starts[photo + 1])
                counts = np.bincount(labels, minlength=2)
                counts[labels[photo]] -= 1
                values = gains[own, 0, labels[neighbors[own]]].sum(), gains[own, 1, labels[neighbors[own]]].sum()
                advantage = np.diff(np.array(values) + np.log(np.maximum(counts, 1)))[0]
                if (advantage if labels[photo] == 0 else -advantage) > 1e-9:  # equal sums may differ by rounding
                    labels[photo], changed = 1 - labels[photo], True
        return labels

    def _pair_gains(self, places: IndexArray, rows: IndexArray) -> FloatArray:
        """Return the log-likelihoods of the pairs `rows` if photo k has the focal at `places[k]`."""
        first, second = places[self.members[rows]].T
        return np.asarray(self.gains[rows, first, second], np.float64)
