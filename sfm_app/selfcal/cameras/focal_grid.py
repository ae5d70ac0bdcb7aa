"""Votes of pairs for the focals of their two photos, on a common grid.

Ours: the consensus of thesis 5.8.4 on the focals alone.
"""

import numpy as np

from sfm_app.selfcal.adjustment.camera_priors import FOCAL_SPREAD, USUAL_FOCAL
from sfm_app.selfcal.adjustment.tied_priors import FAMILY_SPREAD
from sfm_app.selfcal.cameras.max_sum import best_places
from sfm_app.selfcal.cameras.multi_camera import FOCALS, IndexArray, VoteTables
from sfm_app.selfcal.consensus.peak_search import FOCAL_RANGE
from sfm_app.selfcal.inputs import FloatArray
from sfm_app.selfcal.lens import LOG_FOCAL

SIGMA = 0.05
"""Width of the votes, in units of r: neighbors on the grid of focals, 7 % apart, still vote for each other. Chosen by
hand; halved and doubled by `benchmarks.sensitivity`."""
MOST_PAIRS = 1500
"""Most pairs that vote, evenly chosen: tables of all focals of both photos take 13 kB a pair. Chosen by hand; halved
and doubled by `benchmarks.sensitivity`."""


def subsample_pairs(count: int) -> IndexArray:
    """Return the indices of the pairs that vote, evenly chosen out of `count`."""
    return np.linspace(0, count - 1, min(count, MOST_PAIRS)).astype(np.int64)


class FocalGrid:
    """Votes of pairs for the focals of their two photos.

    Args:
        tables: undistorted pairs.
        rows: (P,) indices of the pairs that vote.
        theta: (5,) camera with the center and aspect of all photos.
        members: (P, 2) photos, counted from 0.
    """

    def __init__(self, tables: VoteTables, rows: IndexArray, theta: FloatArray, members: IndexArray) -> None:
        self.votes, self.members = _tabulate_votes(tables, rows, theta), members
        self.grid = np.log(np.geomspace(*FOCAL_RANGE, FOCALS))

    def places(self, cameras: IndexArray, rows: IndexArray) -> IndexArray:
        """Return (C,) grid indices of the focals on which the given pairs agree.

        Args:
            cameras: camera of each photo, counted from 0.
            rows: the pairs that vote.
        """
        one = np.einsum("pgg->g", self.votes[rows]) - 0.5 * ((self.grid - USUAL_FOCAL) / FOCAL_SPREAD) ** 2
        priors = -0.5 * ((self.grid - self.grid[np.argmax(one)]) / FAMILY_SPREAD) ** 2
        if np.max(cameras) == 0:
            return np.array([np.argmax(one)])
        own = np.tile(priors, (int(np.max(cameras)) + 1, 1))
        between: dict[tuple[int, int], FloatArray] = {}
        for row in rows:
            i, j = (int(cameras[photo]) for photo in self.members[row])
            table = self.votes[row]
            if i == j:
                own[i] += np.diag(table)
            else:
                key, table = ((i, j), table) if i < j else ((j, i), table.T)
                between[key] = between.get(key, 0.0) + table
        return best_places(own, between)

    def pair_votes(self, places: IndexArray) -> FloatArray:
        """Return (P,) votes of the pairs if photo k has the focal at `places[k]`."""
        first, second = places[self.members].T
        return np.asarray(self.votes[np.arange(len(self.votes)), first, second], np.float64)

    def fitted_votes(self, cameras: IndexArray) -> float:
        """Return the sum of the votes for the focals on which all pairs agree."""
        return float(np.sum(self.pair_votes(self.places(cameras, np.arange(len(self.votes)))[cameras])))

    def held_out_votes(self, cameras: IndexArray, fold: IndexArray) -> FloatArray:
        """Return (P,) votes of every pair for the focals on which the pairs of the other folds agree.

        Args:
            cameras: camera of each photo, counted from 0.
            fold: (P,) number of the fold of each pair.
        """
        found = np.zeros(len(self.votes))
        for number in np.unique(fold):
            out = fold == number
            found[out] = self.pair_votes(self.places(cameras, np.flatnonzero(~out))[cameras])[out]
        return found


def _tabulate_votes(tables: VoteTables, rows: IndexArray, theta: FloatArray) -> FloatArray:
    trials = np.repeat(theta[None], FOCALS, axis=0)
    trials[:, LOG_FOCAL] = np.log(np.geomspace(*FOCAL_RANGE, FOCALS))
    trials[:, -1] = 0.0
    return np.array([tables.votes(int(row), trials, trials, SIGMA) for row in rows])
