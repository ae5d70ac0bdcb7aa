"""The highest peak of the joint consensus: a coarse grid over K, then local searches from its best cells.

Ours, in place of the search along zero curves of thesis 5.8.4 (Eq. 5.33).
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from sfm_app.selfcal.consensus.consensus import Consensus
from sfm_app.selfcal.inputs import FloatArray

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
