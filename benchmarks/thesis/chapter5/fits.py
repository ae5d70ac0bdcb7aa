"""Fundamental matrices as in thesis section 5.5.3: robust ones, and outlying ones that are fitted to all matches."""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

import sfm_app
from sfm_app.fundamental.points import prepare
from sfm_app.fundamental.refits import fit_eight_point
from sfm_app.types import EpipolarFit
from sfm_app.types.photos import PairId

FloatArray = NDArray[np.float64]


class Fit(NamedTuple):
    """One fundamental matrix and the matches that support it."""

    F: FloatArray
    """(3, 3) in pixels."""
    matches: FloatArray
    """(N, 4) x1, y1, x2, y2 in pixels."""


Fits = Mapping[PairId, Fit]


def robust_fits(matches: Mapping[PairId, FloatArray], seed: int) -> dict[PairId, Fit]:
    """Fit every pair by LEV-RANSAC, without those that it rejects or calls degenerate."""
    found = {}
    for pair, rows in matches.items():
        own_seed = int(np.random.SeedSequence([seed, *pair]).generate_state(1)[0])
        fit = sfm_app.estimate_fundamental(rows[:, :2], rows[:, 2:], seed=own_seed)
        if isinstance(fit, EpipolarFit) and not fit.degeneracy:
            found[pair] = Fit(fit.F, rows[fit.inliers])
    return found


def fit_to_all(rows: FloatArray) -> Fit:
    """Run the 8-point algorithm on all matches (N, 4), outliers included: an outlying fundamental matrix."""
    matches = prepare(rows[:, :2], rows[:, 2:], seed=0)
    return Fit(matches.to_pixels(fit_eight_point(matches.points, np.ones(len(matches.points)))), rows)


def with_outlying_fits(clean: Fits, spoilt: Mapping[PairId, FloatArray]) -> dict[PairId, Fit]:
    """Replace the clean matrices of some pairs by fits to all of the given matches."""
    return {**clean, **{pair: fit_to_all(rows) for pair, rows in spoilt.items()}}
