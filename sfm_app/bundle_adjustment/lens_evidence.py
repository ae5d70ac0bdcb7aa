"""Cameras from the normal equations of a bundle: which parts are freed, their estimates and deviations.

Ours; the choice by marginal likelihood is that of `geometry.model_selection`.

As for pairs (`camera_priors`): each part of a camera has a narrow prior about its usual value and a wide one, and is
freed where the evidence for the wide one outweighs how rare such cameras are. Freed or not, the prior stays in the
estimate: what the photos do not determine stays where it usually is.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sfm_app.bundle_adjustment.normal_equations import CAMERA, CX, CY, FX, FY, K1, K2, P1, P2, ReducedSystem
from sfm_app.geometry.model_selection import NormalPriors, binary_choices, cavity, posteriors
from sfm_app.geometry.spd_solve import inverse_of_positive
from sfm_app.selfcal.adjustment.camera_priors import ASPECT, CENTER, FREE_SHARE, LENS, NARROW, WIDE

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

LOG_FOCAL, LOG_ASPECT = FX, FY
"""Columns of log sqrt(fx fy) and log fy/fx, which replace fx and fy."""


@dataclass(frozen=True, slots=True)
class Part:
    """Parameters of a camera that are freed together."""

    name: str
    places: tuple[int, ...]
    narrow: float
    """Standard deviation about the usual value; the center's in longer sides."""
    wide: float
    share: float
    """Share of cameras for which the wide prior is the right one."""
    stays: bool
    """Whether it keeps its value where the photos do not determine it; otherwise it moves to its usual value. Mapping
    starts from a calibrated center and aspect, but estimates distortion without a prior."""


PARTS = (
    Part("center", (CX, CY), NARROW[CENTER], WIDE[CENTER], FREE_SHARE[CENTER], True),
    Part("aspect", (LOG_ASPECT,), NARROW[ASPECT], WIDE[ASPECT], FREE_SHARE[ASPECT], True),
    Part("k1", (K1,), NARROW[LENS], WIDE[LENS], FREE_SHARE[LENS], False),
    Part("k2", (K2,), 0.01, 0.2, 0.3, False),
    Part("p1 p2", (P1, P2), 0.0002, 0.002, 0.05, True),
)
"""The priors of center, aspect and k1 are those of `camera_priors`; k2, p1 and p2: docs/algorithms.md, Bundle
adjustment. Chosen by hand; not measured on their own."""
FOCAL_SPREAD = 0.7
"""Prior standard deviation of log f about the value from mapping: hardly a constraint. Chosen by hand; not measured on
its own."""
UNDETERMINED = 0.5
"""A part keeps its value unless the photos shrink its prior deviation below this share: freeing it adds error.
docs/algorithms.md, Bundle adjustment. Chosen by hand; not measured on its own."""
FEW = 2.0
"""Factor on the deviations of cameras with few photos, whose misfit does not average out. docs/algorithms.md, Bundle
adjustment. Chosen by hand; not measured on its own."""
SWEEPS = 5
"""Most sweeps over all cameras in the choice of free parts. Chosen by hand; not measured on its
own."""
LONGEST_STEP = 1.0
"""Longest step of log f: a camera that moves further after mapping is not determined by its photos. Chosen
by hand, on no set: it is more than the prior's standard deviation, and none of six sets that were run reached it."""
FOCALS = (0.05, 100.0)
"""In longer sides: a view of 169 degrees, and one of half a degree. What lies outside has run away. docs/algorithms.md,
Bundle adjustment. Chosen by hand; not measured on their own."""
MISFIT = 4.0
"""Ratio of the errors of cameras to those that independent noise explains: lens models are inexact, and errors of
neighboring observations are correlated. Chosen on the photo sets with known cameras (docs/algorithms.md, Bundle
adjustment)."""


@dataclass(frozen=True, slots=True, eq=False)
class LensPriors:
    """Priors on the cameras, one row each."""

    centers: FloatArray
    """(C, 2) usual optical centers in pixels: the middle of the photo."""
    sides: FloatArray
    """(C,) longer side in pixels."""
    asked: BoolArray
    """(C, 5) parts that are estimated, in the order of PARTS; the others keep their values."""

    def precision(self, free: BoolArray) -> FloatArray:
        """Return (C, 8) precisions of the prior, the wide one for the parts in `free` (C, 5)."""
        deviation = np.full((len(free), CAMERA), FOCAL_SPREAD)
        for k, part in enumerate(PARTS):
            unit = self.sides if part.name == "center" else np.ones(len(free))
            sigma = np.where(free[:, k], part.wide, part.narrow) * unit
            deviation[:, list(part.places)] = sigma[:, None]
        return np.asarray(deviation**-2.0, np.float64)

    def choice_priors(self, trials: BoolArray, camera: int, away: FloatArray) -> NormalPriors:
        """Return the priors of one camera under each of K choices.

        Args:
            trials: (K, 5) the choices.
            camera: row of the camera.
            away: (8,) from it to its usual values.
        """
        alike = LensPriors(np.zeros((len(trials), 2)), np.full(len(trials), self.sides[camera]), trials)
        share = np.array([part.share for part in PARTS])
        log_odds = np.sum(np.log(np.where(trials, share, 1.0 - share)), axis=1)
        return NormalPriors(alike.precision(trials), np.tile(away, (len(trials), 1)), log_odds)

    def prior_offsets(self, params: FloatArray) -> FloatArray:
        """Return (C, 8) offsets from the cameras to their usual values; 0 for the focal and for parts not estimated."""
        away = np.zeros_like(params)
        away[:, [CX, CY]] = self.centers - params[:, [CX, CY]]
        away[:, LOG_ASPECT] = np.log(params[:, FX] / params[:, FY])
        away[:, [K1, K2, P1, P2]] = -params[:, [K1, K2, P1, P2]]
        return np.where(parameter_mask(self.asked), away, 0.0)


@dataclass(frozen=True, slots=True, eq=False)
class LensEstimate:
    """The most probable cameras, with their uncertainty."""

    params: FloatArray
    """(C, 8) as in `Bundle`."""
    deviations: FloatArray
    """(C, 8) their standard deviations."""
    free: BoolArray
    """(C, 5) the parts that have the wide prior, in the order of PARTS."""
    determined: BoolArray
    """(C, 5) the parts that the photos determine better than the prior."""
    step: float
    """The largest change of a parameter, in standard deviations."""
    held: BoolArray
    """(C,) cameras whose step was refused because it diverged; no part of them counts as determined."""


def estimate_lenses(params: FloatArray, reduced: ReducedSystem, priors: LensPriors) -> LensEstimate:
    """Return the most probable cameras under the most probable choice of freed parts; undetermined parts stay.

    Deviations are root mean squares about the returned values, over all choices of freed parts. They are at least
    those of the sandwich estimator with photos as clusters, which grows where photos contradict each other (a zoom, a
    rolling shutter, look-alikes).

    Args:
        params: (C, 8) cameras as in `Bundle`.
        reduced: the cost about these cameras.
        priors: on the cameras.
    """
    T = _logarithm_jacobian(params)
    weight = (MISFIT * reduced.noise_px) ** -2.0
    H, g = weight * _multiply(T.T, _multiply(reduced.H, T)), weight * _multiply(T.T, reduced.g)
    away = priors.prior_offsets(params)
    free = _choose(H, g, away, priors)
    precision = priors.precision(free)
    _, covariance = _posterior(H, g, precision, away, np.ones_like(away, np.bool_))
    determined = priors.asked & _find_determined(covariance, precision)
    changing = parameter_mask(determined | (priors.asked & ~np.array([part.stays for part in PARTS])))
    step, own = _posterior(H, g, precision, away, changing)
    about = _mean_squares(step, H, g, away, priors, free)
    photos = weight * _multiply(reduced.scores, T)
    variances = np.maximum(
        np.sum(_multiply(T, about) * T, axis=1), np.sum(_multiply(photos, _multiply(covariance, T.T)) ** 2, axis=0)
    )
    deviations = np.sqrt(variances).reshape(params.shape) * np.where(priors.asked.all(axis=1), 1.0, FEW)[:, None]
    largest = np.abs(step) / np.sqrt(np.diag(own), out=np.ones_like(step), where=changing.ravel())
    moved, held = _apply_step(params, step.reshape(params.shape), priors.sides)
    deviations[held] = np.maximum(deviations[held], _prior_deviations(params, priors)[held])
    determined[held] = False
    return LensEstimate(
        np.where(held[:, None], params, moved), deviations, free & determined, determined,
        float(np.max(largest.reshape(params.shape)[~held], initial=0.0)), held,
    )  # fmt: skip


def parameter_mask(parts: BoolArray) -> BoolArray:
    """Return (C, 8) mask of the parameters of some parts (C, 5), and of the focal."""
    chosen = np.ones((len(parts), CAMERA), np.bool_)
    for k, part in enumerate(PARTS):
        chosen[:, list(part.places)] = parts[:, [k]]
    return chosen


def _posterior(
    H: FloatArray, g: FloatArray, precision: FloatArray, away: FloatArray, changing: BoolArray
) -> tuple[FloatArray, FloatArray]:
    """Return mean step (8C,) and covariance (8C, 8C) of the parameters in `changing` (C, 8); 0 elsewhere."""
    places = np.flatnonzero(changing)
    step, covariance = np.zeros(len(g)), np.zeros_like(H)
    block = np.ix_(places, places)
    covariance[block] = inverse_of_positive((H + np.diag(precision.ravel()))[block])
    step[places] = _multiply(covariance[block], (g + (precision * away).ravel())[places])
    return step, covariance


def _find_determined(covariance: FloatArray, precision: FloatArray) -> BoolArray:
    """Return (C, 5) as in `LensEstimate`."""
    narrower = np.sqrt(np.diag(covariance)).reshape(precision.shape) < UNDETERMINED * precision**-0.5
    return np.stack([narrower[:, list(part.places)].all(axis=1) for part in PARTS], axis=1)


def _choose(H: FloatArray, g: FloatArray, away: FloatArray, priors: LensPriors) -> BoolArray:
    """Return the most probable choice (C, 5).

    In one sweep all cameras are asked, with the choices for the others as they were before it. `camera_priors` asks
    one after the other: a posterior of all for each of them, which is too slow for hundreds of cameras.
    """
    free, everything = np.zeros((len(away), len(PARTS)), np.bool_), np.ones_like(away, np.bool_)
    for _ in range(SWEEPS):
        before, precision = free, priors.precision(free)
        step, covariance = _posterior(H, g, precision, away, everything)
        free = np.empty_like(before)
        for camera, own in enumerate(np.arange(len(g)).reshape(away.shape)):
            trials = binary_choices(len(PARTS))
            trials = trials[~np.any(trials & ~priors.asked[camera], axis=1)]
            said = cavity(covariance[np.ix_(own, own)], step[own], precision[camera], away[camera])
            found = posteriors(*said, priors.choice_priors(trials, camera, away[camera]))
            free[camera] = trials[np.argmax(found.log_evidence)]
        if np.array_equal(free, before):
            break
    return free


def _mean_squares(
    step: FloatArray, H: FloatArray, g: FloatArray, away: FloatArray, priors: LensPriors, free: BoolArray
) -> FloatArray:
    """Return (8C, 8C) mean squares of the cameras about a step, over all choices for each, the others as in `free`.

    Choices that the photos were not asked about count, too: a part is no better known because nobody asked.
    """
    precision = priors.precision(free)
    mean, covariance = _posterior(H, g, precision, away, np.ones_like(away, np.bool_))
    found = covariance + np.outer(mean - step, mean - step)
    for camera, own in enumerate(np.arange(len(g)).reshape(away.shape)):
        block = np.ix_(own, own)
        said = cavity(covariance[block], mean[own], precision[camera], away[camera])
        choices = priors.choice_priors(binary_choices(len(PARTS)), camera, away[camera])
        found[block] = posteriors(*said, choices).mean_squares(step[own])
    return found


def _logarithm_jacobian(params: FloatArray) -> FloatArray:
    """Return (8C, 8C) derivatives of the parameters by those with log f and log fy/fx in place of fx and fy."""
    T = np.eye(params.size)
    for camera, values in enumerate(params):
        x, y = CAMERA * camera + FX, CAMERA * camera + FY
        T[x, [x, y]] = values[FX], -0.5 * values[FX]
        T[y, [x, y]] = values[FY], 0.5 * values[FY]
    return T


def _multiply(A: FloatArray, B: FloatArray) -> FloatArray:
    """Return A B without BLAS, whose sums depend on its threads."""
    return np.asarray(np.einsum("ij,j...->i...", A, B), np.float64)


def _apply_step(params: FloatArray, step: FloatArray, sides: FloatArray) -> tuple[FloatArray, BoolArray]:
    """Return the cameras (C, 8) after a step, and (C,) those that it makes diverge."""
    moved = params + step
    with np.errstate(over="ignore", invalid="ignore"):
        moved[:, FX] = params[:, FX] * np.exp(step[:, LOG_FOCAL] - 0.5 * step[:, LOG_ASPECT])
        moved[:, FY] = params[:, FY] * np.exp(step[:, LOG_FOCAL] + 0.5 * step[:, LOG_ASPECT])
        focals = moved[:, [FX, FY]] / sides[:, None]
    priors = np.isfinite(moved).all(axis=1) & np.all((focals > FOCALS[0]) & (focals < FOCALS[1]), axis=1)
    return moved, ~priors | (np.abs(step[:, LOG_FOCAL]) > LONGEST_STEP)


def _prior_deviations(params: FloatArray, priors: LensPriors) -> FloatArray:
    """Return (C, 8) standard deviations of cameras that the photos do not determine."""
    deviations = priors.precision(np.ones((len(params), len(PARTS)), np.bool_)) ** -0.5
    deviations[:, [FX, FY]] = FOCAL_SPREAD * params[:, [FX, FY]]
    return np.asarray(deviations, np.float64)
