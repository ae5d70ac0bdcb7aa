"""Cameras of one folder are alike: what is believed about each follows what is found of the others.

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

TIE = 0.3
"""Standard deviation of log f among the photos of one folder. Of reichstag10's ten cameras it is 0.31; photos about
which no pair says anything follow the others. The set that it was compared with is named in
benchmarks/corpus/tuning_sets.py."""
LEAST = 2
"""Photos that are tied; one alone has nobody to follow. By definition."""


@dataclass(frozen=True, slots=True, eq=False)
class Tied(CameraPriors):
    """Priors whose focals scatter about a mean of their own: hierarchical, with the mean where it is best."""

    families: NDArray[np.int64] = field(default_factory=lambda: np.empty(0, np.int64))
    """(C,) number of the family of a camera; -1: it is of none."""

    def prior(self, free: BoolArray, thetas: FloatArray, held: BoolArray | None = None) -> Prior:
        """Give the prior; the mean of a family is that of its cameras, drawn towards the usual focal.

        Args:
            free: (C, 4) what is freed.
            thetas: (C, 5) parameters of the cameras.
            held: (C, 4) what stays at its usual value; nothing where None.
        """
        plain = CameraPriors.prior(self, free, thetas, held)
        mean, precision = plain.mean.copy(), plain.precision.copy()
        claimed = ~free[:, FOCAL] & np.isfinite(self.hints)
        for family in np.unique(self.families[self.families >= 0]):
            members = np.flatnonzero(self.families == family)
            if len(members) < LEAST:
                continue
            priors = USUAL_FOCAL + np.log(self.sides[members])
            weight = len(members) / TIE**2
            away = np.sum(thetas[members, LOG_FOCAL] - priors) / TIE**2 / (weight + FOCAL_SPREAD**-2)
            asked = ~claimed[members]
            mean[members[asked], LOG_FOCAL] = (priors + away)[asked]
            precision[members[asked], LOG_FOCAL] = TIE**-2
        return Prior(mean, precision)
