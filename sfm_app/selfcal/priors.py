"""Hierarchical priors on focals: cameras of one folder are alike, so that each is tied to the others.

Ours.
"""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from sfm_app.geometry.least_squares import (
    NormalPriors,
    Posteriors,
    binary_choices,
    cavity,
    inverses_of_positive,
    posteriors,
)
from sfm_app.selfcal.adjustment import CAMERA, Prior
from sfm_app.selfcal.pairs import CENTER_U, KAPPA, LOG_ASPECT, LOG_FOCAL
from sfm_app.types.arrays import BoolArray, FloatArray

# Priors on cameras, and the choice of the parameters that the pairs free from their usual values.
#
# Ours; the choice by marginal likelihood is that of `geometry.model_selection`.
#
# Most photos are uncropped, their pixels square, their lens nearly straight; some are not. So center, aspect and
# lens each have two priors: a narrow one about the usual value, and a wide one. A parameter is freed only where the
# evidence for the wide prior outweighs how rare such photos are; otherwise it stays near its usual value. A focal
# that EXIF claims is one more narrow prior, which loses against pairs that contradict it.

CENTER, ASPECT, LENS, FOCAL = range(4)
"""Columns of `free`: the parts of a camera that may be freed from their usual values."""
NAMES = ("center", "aspect", "k1", "focal")
"""Names of the parts in `Calibration.held`."""
USUAL_FOCAL, FOCAL_SPREAD = np.log(1.2), 0.7
"""Prior mean and standard deviation of log f, f in longer sides, without a claimed focal. The mean is COLMAP's guess;
the deviation, a factor of two, was chosen by hand."""
HINT_SPREAD = 0.05
"""Standard deviation of the logarithm of a claimed focal: EXIF rounds millimeters, and the sensor size to 35 mm. Chosen
by hand; halved and doubled by `benchmarks.sensitivity`."""
NARROW = {CENTER: 0.012, ASPECT: 0.002, LENS: 0.005}
"""Standard deviations about the usual value: of the center in longer sides, of log fy/fx, of k1. docs/algorithms.md,
Self-calibration, 3. Chosen by hand; halved and doubled by `benchmarks.sensitivity`."""
WIDE = {CENTER: 0.15, ASPECT: 0.25, LENS: 0.2}
"""Standard deviations of freed parts, in the same units. docs/algorithms.md, Self-calibration, 3. Chosen by hand;
halved and doubled by `benchmarks.sensitivity`."""
COLUMNS = {CENTER: [CENTER_U, CENTER_U + 1], ASPECT: [LOG_ASPECT], LENS: [KAPPA]}
"""Columns of each part in the parameters of a camera, by definition in `lens`."""
UNDETERMINED = 0.5
"""A part stays at its usual value unless the pairs shrink the deviation of its narrow prior below this share.
docs/algorithms.md, Self-calibration, 3. Chosen by hand; halved and doubled by `benchmarks.sensitivity`."""
STAYS = 1e-3
"""Factor on the prior deviation of a part that stays at its usual value. Chosen by hand; halved and doubled by
`benchmarks.sensitivity`."""
LEAST_SPARE = 0.25
"""Share of the constraints that must be left to contradict the cameras, or nothing more is freed. Three pairs fit
almost any center (docs/algorithms.md, Self-calibration, 3). Chosen by hand; halved and doubled by
`benchmarks.sensitivity`."""
STRAIGHT = 1e-6
"""Deviation of k1, and share of distorted photos, when distortion is not estimated: practically zero. Chosen by hand;
halved and doubled by `benchmarks.sensitivity`."""
FREE_SHARE = {CENTER: 0.3, ASPECT: 0.05, LENS: 0.5, FOCAL: 0.3}
"""Share of photo sets in which the wide prior is the right one; for FOCAL, in which a claim is wrong.
docs/algorithms.md, Self-calibration, 3. Chosen by hand; halved and doubled by `benchmarks.sensitivity`."""


@dataclass(frozen=True, slots=True, eq=False)
class CameraPriors:
    """Priors on the cameras, one row each."""

    sides: FloatArray
    """(C,) longer side of the photos, in the units of the matches."""
    hints: FloatArray
    """(C,) claimed focal in the same units, NaN where nobody claims one."""
    center_sigma: float = WIDE[CENTER]
    """Wide prior on the center, in longer sides."""
    lens: bool = True
    """Whether distortion is estimated."""

    def prior(self, free: BoolArray, thetas: FloatArray, held: BoolArray | None = None) -> Prior:
        """Return the prior for a choice of freed parts.

        Args:
            free: (C, 4) the freed parts.
            thetas: (C, 5) parameters of the cameras; they convert k1 to kappa.
            held: (C, 4) the parts that stay at their usual values; none if None.
        """
        mean, deviation = np.zeros((len(self.sides), CAMERA)), np.empty((len(self.sides), CAMERA))
        hinted = ~free[:, FOCAL] & np.isfinite(self.hints)
        with np.errstate(invalid="ignore"):
            mean[:, LOG_FOCAL] = np.where(hinted, np.log(self.hints), USUAL_FOCAL + np.log(self.sides))
        deviation[:, LOG_FOCAL] = np.where(hinted, HINT_SPREAD, FOCAL_SPREAD)
        wide = self.center_sigma
        deviation[:, CENTER_U : CENTER_U + 2] = (np.where(free[:, CENTER], wide, NARROW[CENTER]) * self.sides)[:, None]
        deviation[:, LOG_ASPECT] = np.where(free[:, ASPECT], WIDE[ASPECT], NARROW[ASPECT])
        k1 = np.where(free[:, LENS], WIDE[LENS], NARROW[LENS]) if self.lens else STRAIGHT
        deviation[:, KAPPA] = k1 / np.exp(2.0 * thetas[:, LOG_FOCAL])
        if held is not None:
            for place, columns in COLUMNS.items():
                for column in columns:
                    deviation[held[:, place], column] *= STAYS
        return Prior(mean, deviation**-2.0)

    def log_odds(self, free: BoolArray) -> float:
        """Return the prior log-probability of a choice (C, 4)."""
        total = 0.0
        for place, share in FREE_SHARE.items():
            counts = np.isfinite(self.hints) if place == FOCAL else np.ones(len(self.sides), np.bool_)
            freed = share if place != LENS or self.lens else STRAIGHT
            total += float(np.sum(np.log(np.where(free[counts, place], freed, 1.0 - freed))))
        return total


@dataclass(frozen=True, slots=True, eq=False)
class Evidence:
    """The negative log-likelihood of all pairs near `thetas`: -g'd + d'Hd / 2 for a step d of the cameras."""

    thetas: FloatArray
    """(C, 5) parameters of the cameras."""
    H: FloatArray
    """(5C, 5C) Hessian of the negative log-likelihood."""
    g: FloatArray
    """(5C,) its negative gradient."""
    pairs: float
    """Effective number of pairs behind it."""
    priors: CameraPriors

    def posterior(self, free: BoolArray) -> tuple[float, FloatArray, FloatArray]:
        """Return the log-probability of a choice (C, 4) up to a constant, and the mean step and covariance under it."""
        prior = self.priors.prior(free, self.thetas)
        precision, away = prior.precision.ravel(), (prior.mean - self.thetas).ravel()
        share = spare_share(free, self.pairs)
        covariance = inverses_of_positive(share * self.H + np.diag(precision))
        pull = share * self.g + precision * away
        step = covariance @ pull
        fit = 0.5 * float(pull @ step) - 0.5 * float(precision @ away**2)
        volume = 0.5 * float(np.sum(np.log(precision))) + 0.5 * float(np.linalg.slogdet(covariance)[1])
        return fit + volume + self.priors.log_odds(free), step, covariance

    def choices(self, free: BoolArray, camera: int) -> BoolArray:
        """Return (K, C, 4) all choices for one camera; those that free less come first.

        Choices that leave hardly any redundant constraint are left out: three pairs fit almost any center.

        Args:
            free: (C, 4) the choices for the other cameras.
            camera: row of the one.
        """
        switches = binary_choices(free.shape[1])
        trials = np.repeat(free[None], len(switches), axis=0)
        trials[:, camera] = switches
        allowed = [k == 0 or spare_share(trial, self.pairs) >= LEAST_SPARE for k, trial in enumerate(trials)]
        return np.asarray(trials[allowed], np.bool_)

    def choose(self, free: BoolArray) -> BoolArray:
        """Return the most probable choice.

        One camera after the other is asked, with the choices for the others as they stand, until none changes.

        Args:
            free: (C, 4) where to begin.
        """
        while True:
            before = free
            for camera in range(len(free)):
                _, step, covariance = self.posterior(free)
                trials, found = self.camera_posteriors(free, camera, step, covariance)
                free = trials[np.argmax(found.log_evidence)]
            if np.array_equal(free, before):
                return free

    def undetermined_parts(self, free: BoolArray) -> BoolArray:
        """Return (C, 4) the parts that are not freed, not narrowed by the pairs, and not contradicted by them.

        Args:
            free: (C, 4) the choices for all cameras.
        """
        prior = self.priors.prior(free, self.thetas)
        before = prior.precision**-0.5
        after = np.sqrt(np.diag(self.posterior(free)[2])).reshape(before.shape)
        vague, near = after > UNDETERMINED * before, np.abs(self.thetas - prior.mean) < after
        found = np.zeros_like(free)
        for place, columns in COLUMNS.items():
            found[:, place] = ~free[:, place] & vague[:, columns].any(axis=1) & near[:, columns].all(axis=1)
        return found

    def covariance(self, free: BoolArray) -> FloatArray:
        """Return (5C, 5C) mean squares of the cameras about `thetas`, over all choices for each camera.

        A parameter that is nearly freed is nearly as uncertain as a freed one.

        Args:
            free: (C, 4) the choices for the other cameras.
        """
        _, step, covariance = self.posterior(free)
        total = covariance.copy()
        for camera in range(len(free)):
            _, found = self.camera_posteriors(free, camera, step, covariance)
            block = slice(CAMERA * camera, CAMERA * (camera + 1))
            total[block, block] = found.mean_squares(np.zeros(CAMERA))
        return total

    def camera_posteriors(
        self, free: BoolArray, camera: int, step: FloatArray, covariance: FloatArray
    ) -> tuple[BoolArray, Posteriors]:
        """Return all choices (K, C, 4) for one camera, and its posterior under each.

        Args:
            free: (C, 4) the choices for all cameras.
            camera: row of the one.
            step: (5C,) mean step of the posterior under `free`.
            covariance: (5C, 5C) of the same posterior.
        """
        block = slice(CAMERA * camera, CAMERA * (camera + 1))
        prior, trials = self.priors.prior(free, self.thetas), self.choices(free, camera)
        away = prior.mean - self.thetas
        H, g = cavity(covariance[block, block], step[block], prior.precision[camera], away[camera])
        others = [self.priors.prior(trial, self.thetas) for trial in trials]
        scale = np.array([spare_share(trial, self.pairs) for trial in trials]) / spare_share(free, self.pairs)
        found = posteriors(
            scale[:, None, None] * H, scale[:, None] * g,
            NormalPriors(
                np.array([other.precision[camera] for other in others]),
                np.array([(other.mean - self.thetas)[camera] for other in others]),
                np.array([self.priors.log_odds(trial) for trial in trials]),
            ),
        )  # fmt: skip
        return trials, found


def spare_share(free: BoolArray, pairs: float) -> float:
    """Return the share of redundant constraints, in [0.1, 1].

    A pair gives two constraints. With fewer redundant ones, residuals underestimate the errors.

    Args:
        free: (C, 4) what is freed.
        pairs: effective number of pairs, >= 0.
    """
    sought = len(free) + 2 * np.count_nonzero(free[:, CENTER]) + np.count_nonzero(free[:, [ASPECT, LENS]])
    return max(1.0 - sought / max(2.0 * pairs, 1e-9), 0.1)


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
