"""What is believed about a camera before a photo is seen, and how far the pairs may change that.

Most photos are uncropped, their pixels square, their lens nearly straight; some are not. So centre, aspect and lens
each have two priors: a narrow one about the usual value, and a wide one. A parameter is freed only where the evidence
for the wide prior (the marginal likelihood, by Laplace's approximation) outweighs how rare such photos are; otherwise
it stays near its usual value. A focal that EXIF claims is one more narrow prior, which loses against pairs that
contradict it.
"""

from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray

from sfm_app.selfcal.adjustment import Prior
from sfm_app.selfcal.lens import CENTRE_U, KAPPA, LOG_ASPECT, LOG_FOCAL
from sfm_app.selfcal.two_view_cost import CAMERA

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

CENTRE, ASPECT, LENS, FOCAL = range(4)
"""Places in `free`: what may be freed from its usual value."""
NAMES = ("centre", "aspect", "k1", "focal")
USUAL_FOCAL, FOCAL_SPREAD = np.log(1.2), 0.7
"""Mean and standard deviation of log f, f in longer sides, where nobody claims one."""
HINT_SPREAD = 0.05
"""Of a claimed focal: EXIF rounds millimetres, and the sensor's size to 35 mm."""
NARROW = {CENTRE: 0.012, ASPECT: 0.002, LENS: 0.005}
"""Standard deviations about the usual value: of the centre in longer sides, of log fy/fx, of k1."""
WIDE = {CENTRE: 0.15, ASPECT: 0.25, LENS: 0.2}
FREE_SHARE = {CENTRE: 0.2, ASPECT: 0.02, LENS: 0.5, FOCAL: 0.3}
"""Share of photo sets in which the wide prior is the right one; for FOCAL, in which a claim is wrong."""


@dataclass(frozen=True, slots=True, eq=False)
class Usual:
    """What is known about the cameras, one row each."""

    sides: FloatArray
    """(C,) longer side of the photos, in the units of the matches."""
    hints: FloatArray
    """(C,) claimed focal in the same units, NaN where nobody claims one."""
    centre_sigma: float = WIDE[CENTRE]
    """Wide prior on the centre, in longer sides."""

    def prior(self, free: BoolArray, thetas: FloatArray) -> Prior:
        """The prior when `free` (C, 4) says what is freed; `thetas` (C, 5) turn k1 into kappa."""
        mean, deviation = np.zeros((len(self.sides), CAMERA)), np.empty((len(self.sides), CAMERA))
        hinted = ~free[:, FOCAL] & np.isfinite(self.hints)
        with np.errstate(invalid="ignore"):
            mean[:, LOG_FOCAL] = np.where(hinted, np.log(self.hints), USUAL_FOCAL + np.log(self.sides))
        deviation[:, LOG_FOCAL] = np.where(hinted, HINT_SPREAD, FOCAL_SPREAD)
        wide = self.centre_sigma
        deviation[:, CENTRE_U : CENTRE_U + 2] = (np.where(free[:, CENTRE], wide, NARROW[CENTRE]) * self.sides)[:, None]
        deviation[:, LOG_ASPECT] = np.where(free[:, ASPECT], WIDE[ASPECT], NARROW[ASPECT])
        k1 = np.where(free[:, LENS], WIDE[LENS], NARROW[LENS])
        deviation[:, KAPPA] = k1 / np.exp(2.0 * thetas[:, LOG_FOCAL])
        return Prior(mean, deviation**-2.0)

    def log_odds(self, free: BoolArray) -> float:
        """Log-probability of a choice, before the pairs are asked."""
        total = 0.0
        for place, share in FREE_SHARE.items():
            counts = np.isfinite(self.hints) if place == FOCAL else np.ones(len(self.sides), np.bool_)
            total += float(np.sum(np.log(np.where(free[counts, place], share, 1.0 - share))))
        return total


def log_evidence(H: FloatArray, b: FloatArray, thetas: FloatArray, prior: Prior) -> float:
    """Log marginal likelihood, up to a constant, of pairs that say -b'd + d'Hd / 2 about a step d from `thetas`.

    Args:
        H: (5C, 5C) Hessian of the negative log-likelihood of the pairs.
        b: (5C,) its negative gradient.
        thetas: (C, 5) where both were taken.
        prior: normal, see `Usual.prior`.
    """
    precision = prior.precision.ravel()
    away = (prior.mean - thetas).ravel()
    A = H + np.diag(precision)
    g = b + precision * away
    least = 0.5 * float(precision @ away**2) - 0.5 * float(g @ np.linalg.solve(A, g))
    return 0.5 * float(np.sum(np.log(precision))) - 0.5 * float(np.linalg.slogdet(A)[1]) - least


def chosen(
    H: FloatArray, b: FloatArray, thetas: FloatArray, usual: Usual, free: BoolArray, pairs: float
) -> tuple[BoolArray, float]:
    """Which parameters the pairs free, and by how many nats that choice beats leaving all as usual.

    One camera: all sixteen choices. Several: one camera after the other, the rest as they are, until none changes.

    Args:
        H: as in `log_evidence`.
        b: as in `log_evidence`.
        thetas: (C, 5) where both were taken.
        usual: the priors.
        free: (C, 4) the choice to begin from.
        pairs: effective number of pairs behind H.
    """

    def value(choice: BoolArray) -> float:
        share = spare(choice, pairs)
        return log_evidence(share * H, share * b, thetas, usual.prior(choice, thetas)) + usual.log_odds(choice)

    free = free.copy()
    while True:
        before = free.copy()
        for camera in range(len(free)):
            trials = []
            for switches in product((False, True), repeat=free.shape[1]):
                trial = free.copy()
                trial[camera] = switches
                trials.append((value(trial), -sum(switches), switches))
            free[camera] = max(trials)[2]
        if np.array_equal(free, before):
            return free, value(free) - value(np.zeros_like(free))


def spare(free: BoolArray, pairs: float) -> float:
    """Share of the constraints that is left to contradict the cameras, in [0.1, 1].

    A pair gives two. The fewer are left, the less the pairs' scatter about the fit says about their errors.
    """
    sought = len(free) + 2 * np.count_nonzero(free[:, CENTRE]) + np.count_nonzero(free[:, [ASPECT, LENS]])
    return max(1.0 - sought / max(2.0 * pairs, 1e-9), 0.1)
