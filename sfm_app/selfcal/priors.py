"""Priors on cameras, and the choice of the parameters that the pairs free from their usual values.

Ours; the choice by marginal likelihood is that of `geometry.least_squares`. Most photos are uncropped, their pixels
square, their lens nearly straight; some are not. So center, aspect and lens each have two priors: a narrow one about
the usual value, and a wide one. A parameter is freed only where the evidence for the wide prior outweighs how rare such
photos are; otherwise it stays near its usual value. A claim about a camera has a narrow prior in place of the usual
one, until freeing its focal rejects all of it. Where photos of one folder have a camera each, a hierarchical prior ties
their focals.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from sfm_app.camera.models import ASPECT, CENTER, FOCAL, FREE_SHARE, LENS, NARROW, WIDE
from sfm_app.geometry import least_squares
from sfm_app.selfcal.adjustment import CAMERA, Prior
from sfm_app.selfcal.pairs import CENTER_U, KAPPA, LOG_ASPECT, LOG_FOCAL
from sfm_app.types import CameraPrior
from sfm_app.types.arrays import BoolArray, FloatArray, IndexArray

NAMES = ("center", "aspect", "k1", "focal")
"""Names of the parts in `Calibration.held`."""
COLUMNS = {CENTER: [CENTER_U, CENTER_U + 1], ASPECT: [LOG_ASPECT], LENS: [KAPPA]}
"""Columns of each part in the parameters of a camera, by definition in `pairs`."""
PART_OF_COLUMN = [FOCAL, CENTER, CENTER, ASPECT, LENS]


class PRIORS:
    """Usual cameras, and how far photos depart from them."""

    usual_log_focal: float = float(np.log(1.2))
    """Mean of log f, f in longer sides, without a claimed focal: COLMAP's guess."""
    focal_spread: float = 0.7
    """Standard deviation of log f without a claimed focal, a factor of two; by hand."""
    family_spread: float = 0.3
    """Standard deviation of log f among photos of one folder; chosen on reichstag10 and random scenes."""
    undetermined: float = 0.5
    """A part is undetermined unless the pairs shrink the deviation of its narrow prior below this share.
    docs/algorithms/zero-curves.md, 3; by hand."""
    held_factor: float = 1e-3
    """Factor on the prior deviation of a part that stays at its usual value: it is undetermined, or a lens that the
    settings exclude. Share of the latter, too; by hand."""
    most_change: float = 1e6
    """Largest ratio of two precisions at which an update of the posterior keeps ten digits. By double precision."""
    least_redundancy: float = 0.25
    """Least share of redundant constraints for freeing more: three pairs fit almost any center.
    docs/algorithms/zero-curves.md, 3; by hand."""


def claim_rows(priors: Sequence[CameraPrior | None], sizes: Sequence[tuple[int, int]], unit_px: float) -> FloatArray:
    """Return the `claims` of `CameraPriors` in units from the middles of photos of these sizes."""
    rows = np.full((2, len(priors), CAMERA), np.nan)
    for k, (prior, size) in enumerate(zip(priors, sizes, strict=True)):
        if prior is None:
            continue
        rows[:, k, LOG_FOCAL] = np.log(prior.focal_px / unit_px), prior.focal_deviation_px / prior.focal_px
        if prior.center_px is not None:
            center = [CENTER_U, CENTER_U + 1]
            rows[0, k, center] = (np.array(prior.center_px) - np.array(size) / 2) / unit_px
            rows[1, k, center] = prior.center_deviation_px / unit_px
        if prior.k1 is not None:
            rows[:, k, KAPPA] = prior.k1, prior.k1_deviation
    return rows


@dataclass(frozen=True, slots=True, eq=False)
class CameraPriors:
    """Priors on the cameras, one row each."""

    sides: FloatArray
    """(C,) longer side of the photos, in the units of the matches."""
    claims: FloatArray
    """(2, C, 5) claimed parameters as in `pairs`, and their deviations, but k1 for kappa; NaN without a claim."""
    center_sigma: float = WIDE[CENTER]
    """Wide prior on the center, in longer sides."""
    lens: bool = True

    def prior(self, free: BoolArray, thetas: FloatArray, held: BoolArray | None = None) -> Prior:
        """Return the prior for freed parts (C, 4) and those `held` at usual values; thetas convert k1 to kappa."""
        freed = free[:, PART_OF_COLUMN]
        usual = np.zeros(freed.shape)
        usual[:, LOG_FOCAL] = PRIORS.usual_log_focal + np.log(self.sides)
        across = self.sides[:, None] * [0, 1, 1, 0, 0] + [1, 0, 0, 1, 1]
        center, k1 = NARROW[CENTER], NARROW[LENS] if self.lens else PRIORS.held_factor * NARROW[LENS]
        narrow = across * [PRIORS.focal_spread, center, center, NARROW[ASPECT], k1]
        center, k1 = self.center_sigma, WIDE[LENS] if self.lens else k1
        wide = across * [PRIORS.focal_spread, center, center, WIDE[ASPECT], k1]
        claimed = np.isfinite(self.claims[0]) & ~freed & ~free[:, [FOCAL]]
        claimed[:, KAPPA] &= self.lens
        mean = np.where(claimed, self.claims[0], usual)
        deviation = np.where(claimed, self.claims[1], np.where(freed, wide, narrow))
        per_kappa = np.exp(2.0 * thetas[:, LOG_FOCAL])
        mean[:, KAPPA] /= per_kappa
        deviation[:, KAPPA] /= per_kappa
        if held is not None:
            for place, columns in COLUMNS.items():
                for column in columns:
                    deviation[held[:, place], column] *= PRIORS.held_factor
        return Prior(mean, deviation**-2.0)

    @property
    def claims_focal(self) -> BoolArray:
        """(C,) whether somebody claims the focal."""
        return np.isfinite(self.claims[0, :, LOG_FOCAL])

    def log_odds(self, free: BoolArray) -> float:
        """Return the prior log-probability of a choice (C, 4)."""
        total = 0.0
        for place, share in FREE_SHARE.items():
            counts = self.claims_focal if place == FOCAL else np.ones(len(self.sides), np.bool_)
            freed = share if place != LENS or self.lens else PRIORS.held_factor
            total += float(np.sum(np.log(np.where(free[counts, place], freed, 1.0 - freed))))
        return total


@dataclass(frozen=True, slots=True, eq=False)
class Evidence:
    """The negative log-likelihood of all pairs near `thetas`: -g'd + d'Hd / 2 for a step d of the cameras."""

    thetas: FloatArray
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
        precision, offset = prior.precision.ravel(), (prior.mean - self.thetas).ravel()
        share = redundancy(free, self.pairs)
        covariance = least_squares.inverses_of_positive(share * self.H + np.diag(precision))
        pull = share * self.g + precision * offset
        step = covariance @ pull
        fit = 0.5 * float(pull @ step) - 0.5 * float(precision @ offset**2)
        volume = 0.5 * float(np.sum(np.log(precision))) + 0.5 * float(np.linalg.slogdet(covariance)[1])
        return fit + volume + self.priors.log_odds(free), step, covariance

    def choices(self, free: BoolArray, camera: int) -> BoolArray:
        """Return (K, C, 4) choices for one camera, less free first, without those of too little redundancy."""
        switches = least_squares.binary_choices(free.shape[1])
        trials = np.repeat(free[None], len(switches), axis=0)
        trials[:, camera] = switches
        allowed = [k == 0 or redundancy(trial, self.pairs) >= PRIORS.least_redundancy for k, trial in enumerate(trials)]
        return np.asarray(trials[allowed], np.bool_)

    def choose(self, free: BoolArray) -> BoolArray:
        """Return the most probable choice (C, 4): each camera in turn takes its best one, until a choice returns."""
        seen = set[bytes]()
        while free.tobytes() not in seen:
            seen.add(free.tobytes())
            share = redundancy(free, self.pairs)
            _, step, covariance = self.posterior(free)
            for camera in range(len(free)):
                trials, posterior = self.camera_posteriors(free, camera, (step, covariance), share)
                best = trials[np.argmax(posterior.log_evidence)]
                if not np.array_equal(best, free):
                    step, covariance = self._with_choice(free, best, camera, (step, covariance))
                    free = best
        return free

    def _with_choice(
        self, free: BoolArray, best: BoolArray, camera: int, normal: tuple[FloatArray, FloatArray]
    ) -> tuple[FloatArray, FloatArray]:
        """Return mean step and covariance after one camera has changed its choice (Woodbury 1950)."""
        step, covariance = normal
        before, after = (self.priors.prior(choice, self.thetas) for choice in (free, best))
        if np.abs(np.log(before.precision[camera] / after.precision[camera])).max() > np.log(PRIORS.most_change):
            _, step, covariance = self.posterior(best)
            return step, covariance
        more = after.precision[camera] - before.precision[camera]
        pull = after.precision[camera] * (after.mean - self.thetas)[camera]
        pull -= before.precision[camera] * (before.mean - self.thetas)[camera]
        block = slice(CAMERA * camera, CAMERA * (camera + 1))
        rows = covariance[:, block]
        gain = rows @ np.linalg.inv(np.eye(CAMERA) + more[:, None] * rows[block]) * more
        covariance = covariance - gain @ rows.T
        return step - gain @ step[block] + covariance[:, block] @ pull, covariance

    def undetermined_parts(self, free: BoolArray) -> BoolArray:
        """Return (C, 4) the parts that are not freed, not narrowed by the pairs, and not contradicted by them."""
        prior = self.priors.prior(free, self.thetas)
        before = prior.precision**-0.5
        after = np.sqrt(np.diag(self.posterior(free)[2])).reshape(before.shape)
        vague, near = after > PRIORS.undetermined * before, np.abs(self.thetas - prior.mean) < after
        undetermined = np.zeros_like(free)
        for place, columns in COLUMNS.items():
            undetermined[:, place] = ~free[:, place] & vague[:, columns].any(axis=1) & near[:, columns].all(axis=1)
        return undetermined

    def covariance(self, free: BoolArray) -> FloatArray:
        """Return (5C, 5C) mean squares of the cameras about `thetas`, over all choices for each camera."""
        _, *normal = self.posterior(free)
        total = normal[1].copy()
        for camera in range(len(free)):
            _, posterior = self.camera_posteriors(free, camera, normal, redundancy(free, self.pairs))
            block = slice(CAMERA * camera, CAMERA * (camera + 1))
            total[block, block] = posterior.mean_squares(np.zeros(CAMERA))
        return total

    def camera_posteriors(
        self, free: BoolArray, camera: int, normal: Sequence[FloatArray], share: float
    ) -> tuple[BoolArray, least_squares.Posteriors]:
        """Return all choices (K, C, 4) for one camera, and its posteriors.

        `normal` are the mean step and the covariance of `free`, and `share` is their redundancy.
        """
        step, covariance = normal
        block = slice(CAMERA * camera, CAMERA * (camera + 1))
        prior, trials = self.priors.prior(free, self.thetas), self.choices(free, camera)
        offset = prior.mean - self.thetas
        H, g = least_squares.cavity(covariance[block, block], step[block], prior.precision[camera], offset[camera])
        others = [self.priors.prior(trial, self.thetas) for trial in trials]
        scale = np.array([redundancy(trial, self.pairs) for trial in trials]) / share
        posterior = least_squares.posteriors(
            scale[:, None, None] * H, scale[:, None] * g,
            least_squares.NormalPriors(
                np.array([other.precision[camera] for other in others]),
                np.array([(other.mean - self.thetas)[camera] for other in others]),
                np.array([self.priors.log_odds(trial) for trial in trials]),
            ),
        )  # fmt: skip
        return trials, posterior


def redundancy(free: BoolArray, pairs: float) -> float:
    """Return the share of redundant constraints, in [0.1, 1], for freed parts (C, 4): a pair gives two."""
    unknowns = len(free) + 2 * np.count_nonzero(free[:, CENTER]) + np.count_nonzero(free[:, [ASPECT, LENS]])
    return max(1.0 - unknowns / max(2.0 * pairs, 1e-9), 0.1)


@dataclass(frozen=True, slots=True, eq=False)
class TiedPriors(CameraPriors):
    """Hierarchical priors: the focals of a family scatter about their own mean, which is set to its optimum."""

    families: IndexArray = field(default_factory=lambda: np.empty(0, np.int64))
    """(C,) number of each camera's family; -1 for none."""

    def prior(self, free: BoolArray, thetas: FloatArray, held: BoolArray | None = None) -> Prior:
        """Return the prior; the mean of a family is that of its cameras, shrunk towards the usual focal."""
        plain = CameraPriors.prior(self, free, thetas, held)
        mean, precision = plain.mean.copy(), plain.precision.copy()
        claimed = ~free[:, FOCAL] & self.claims_focal
        for family in np.unique(self.families[self.families >= 0]):
            members = np.flatnonzero(self.families == family)
            if len(members) < 2:  # a single photo has no others to follow
                continue
            priors = PRIORS.usual_log_focal + np.log(self.sides[members])
            weight = len(members) / PRIORS.family_spread**2
            total = weight + PRIORS.focal_spread**-2
            shift = np.sum(thetas[members, LOG_FOCAL] - priors) / PRIORS.family_spread**2 / total
            unclaimed = ~claimed[members]
            mean[members[unclaimed], LOG_FOCAL] = (priors + shift)[unclaimed]
            precision[members[unclaimed], LOG_FOCAL] = PRIORS.family_spread**-2
        return Prior(mean, precision)
