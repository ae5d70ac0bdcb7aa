"""Hierarchical priors on focals: cameras of one folder are alike, so that each is tied to the others.

Ours.
"""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from sfm_app.selfcal.adjustment.camera_priors import (
    FOCAL,
    FOCAL_SPREAD,
    USUAL_FOCAL,
    BoolArray,
    CameraPriors,
    FloatArray,
)
from sfm_app.selfcal.adjustment.structureless_ba import Prior
from sfm_app.selfcal.lens import LOG_FOCAL

FAMILY_SPREAD = 0.3
"""Standard deviation of log f among the photos of one folder. Of reichstag10's ten cameras it is 0.31; photos without
informative pairs follow the others. The set that it was compared with is named in benchmarks/corpus/tuning_sets.py."""
LEAST_MEMBERS = 2
"""Least number of photos that are tied: a single photo has no others to follow. By definition."""


@dataclass(frozen=True, slots=True, eq=False)
class TiedPriors(CameraPriors):
    """Hierarchical priors: the focals of a family scatter about their own mean, which is set to its optimum."""

    families: NDArray[np.int64] = field(default_factory=lambda: np.empty(0, np.int64))
    """(C,) number of each camera's family; -1 for none."""

    def prior(self, free: BoolArray, thetas: FloatArray, held: BoolArray | None = None) -> Prior:
        """Return the prior; the mean of a family is that of its cameras, shrunk towards the usual focal.

        Args:
            free: (C, 4) parameters that are freed.
            thetas: (C, 5) parameters of the cameras.
            held: (C, 4) parameters that stay at their usual values; None for no parameters.
        """
        plain = CameraPriors.prior(self, free, thetas, held)
        mean, precision = plain.mean.copy(), plain.precision.copy()
        claimed = ~free[:, FOCAL] & np.isfinite(self.hints)
        for family in np.unique(self.families[self.families >= 0]):
            members = np.flatnonzero(self.families == family)
            if len(members) < LEAST_MEMBERS:
                continue
            priors = USUAL_FOCAL + np.log(self.sides[members])
            weight = len(members) / FAMILY_SPREAD**2
            away = np.sum(thetas[members, LOG_FOCAL] - priors) / FAMILY_SPREAD**2 / (weight + FOCAL_SPREAD**-2)
            asked = ~claimed[members]
            mean[members[asked], LOG_FOCAL] = (priors + away)[asked]
            precision[members[asked], LOG_FOCAL] = FAMILY_SPREAD**-2
        return Prior(mean, precision)
