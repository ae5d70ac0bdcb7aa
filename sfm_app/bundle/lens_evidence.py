"""Cameras from the normal equations of a bundle: free parts, estimates, deviations, and the family of a lens.

Ours. Parts are freed as those of pairs are (`selfcal.priors`); the prior stays in the estimate, so undetermined parts
stay near their usual values. A lens that would fold inside the photo is refused. A perspective lens with strong
distortion is often a fisheye: both are adjusted to the same observations, and their evidence is compared.
"""

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from sfm_app.bundle import lens_parts
from sfm_app.bundle.normal_equations import Bundle, ReducedSystem, bundle_scale, reduce
from sfm_app.camera.projection import angle_limit, radius_at
from sfm_app.camera.rows import CAMERA, CX, CY, FISHEYE, FX, FY, K1, K2, K3, K4, PANORAMA, PERSPECTIVE
from sfm_app.geometry.least_squares import NormalPriors, cavity, inverse_of_positive, posteriors, solve_positive
from sfm_app.types.arrays import BoolArray, FloatArray, IndexArray

if TYPE_CHECKING:
    from scipy import sparse


MISFIT = 4.0
"""Ratio of the errors of cameras to those that independent noise explains: lens models are inexact, and errors of
neighboring observations are correlated. Chosen on photo sets with known cameras
(docs/algorithms/bundle-adjustment.md)."""


class OPTIONS:
    """Limits of the estimate and of the choice of a family."""

    undetermined_share: float = 0.5
    """A part keeps its value unless the photos shrink its prior deviation below this share
    (docs/algorithms/bundle-adjustment.md)."""
    few_photos: float = 2.0
    """Factor on the deviations of cameras with few photos, whose misfit does not average out. Chosen by hand."""
    sweeps: int = 5
    """Most sweeps over all cameras in the choice of free parts. Chosen by hand."""
    longest_step: float = 1.0
    """Longest step of log f: photos do not determine a camera that moves further after mapping. Chosen by hand."""
    focals: tuple[float, float] = (0.05, 100.0)
    """Range of focals in longer sides, views of 169 to 0.5 degrees; others have diverged. Chosen by hand."""
    zero_precision: float = 1e6
    """Factor on the precision of a part at its usual value, so that the others adapt to it. Chosen by hand."""
    clamps: int = 8
    """Most halvings of a step that makes a lens fold inside the photo. Chosen by hand."""
    squeeze: float = 0.8
    """Share of the undistorted radius below which a perspective lens is tried as a fisheye, at the outermost
    observations. An equidistant lens has 0.6 at 120 degrees and 0.76 at 95 degrees. Chosen by hand."""
    narrow_angle: float = float(np.radians(65.0))
    """Largest angle to the optical axis, in radians, of a fisheye to try as a perspective lens. Chosen by hand."""
    samples: int = 200
    """Radii at which a lens is fitted to another. Chosen by hand."""
    least_reach: float = 0.2
    """Smallest share of the observed radius up to which a lens must not fold to be tried as another. Chosen by hand."""
    own_focal: float = 0.2
    """Prior standard deviation of log f of photos about that of their camera: a zoom, or several devices. Chosen by
    hand."""
    divide_log_odds: float = 3.0
    """Least gain in evidence from a division of a camera: one in twenty may be several. Chosen by hand."""
    least_change: float = 0.05
    """Least difference of log f between its photos; focusing changes it less, by 0.03 in oats23. Chosen by hand."""


@dataclass(frozen=True, slots=True)
class LensChoice:
    """A camera model, and how well the photos support it."""

    model: str
    """COLMAP's name of the smallest camera model with these parts."""
    free: tuple[str, ...]
    log_evidence: float
    """Log-probability up to a constant that all models of a camera share."""


@dataclass(frozen=True, slots=True, eq=False)
class LensEstimate:
    """The most probable cameras, with their uncertainty."""

    params: FloatArray
    """(C, 12) as in `Bundle`."""
    deviations: FloatArray
    """(C, 12) their standard deviations."""
    mean_squares: FloatArray
    """(C, 12, 12) mean squares and products of the errors of `params` over all choices; 0 if fixed or diverged."""
    free: BoolArray
    """(C, 8) parts with the wide prior, in the order of PARTS."""
    determined: BoolArray
    """(C, 8) parts that the photos determine better than the prior."""
    step: float
    """The largest change of a parameter, in standard deviations."""
    held: BoolArray
    """(C,) cameras whose step diverged and was refused; no part of them counts as determined."""
    ranking: tuple[tuple[LensChoice, ...], ...]
    """For each camera the best choice of every model, the most probable first."""
    folding: BoolArray
    """(C,) cameras with a more probable lens that folds inside the photo, and was refused."""


def estimate_lenses(params: FloatArray, reduced: ReducedSystem, priors: lens_parts.LensPriors) -> LensEstimate:
    """Return the most probable cameras under the most probable choice of freed parts; undetermined parts stay.

    Deviations are root mean squares about these cameras, over all choices of freed parts. They are at least those of
    the sandwich estimator with photos as clusters, which grows where photos contradict each other. Choices whose lens
    folds inside the photo are barred; if all do, the step is shortened.
    """
    barred = np.zeros(len(params), np.bool_)
    while True:
        chosen, ranking = _choose(*_weigh(params, reduced, priors), priors)
        estimate = _estimate(params, reduced, priors, chosen)
        folding = [k for k, row in enumerate(estimate.params) if not priors.fixed[k] and priors.folds(k, row)]
        others = {camera: priors.drop_lens(camera, chosen[camera]) for camera in folding}
        with_choice = [camera for camera, other in others.items() if len(other.choices[camera])]
        if not with_choice:
            break
        for camera in with_choice:
            priors = priors.drop_lens(camera, chosen[camera])
        barred[with_choice] = True
    clamped = estimate.params.copy()
    for camera in folding:
        clamped[camera] = _shorten_step(params[camera], clamped[camera], camera, priors)
    barred[folding] = True
    return replace(estimate, params=clamped, ranking=ranking, folding=barred)


def _weigh(
    params: FloatArray, reduced: ReducedSystem, priors: lens_parts.LensPriors
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return H (12C, 12C) and g (12C,) by log focal and log aspect, and the offsets of the priors (C, 12)."""
    T, weight = _logarithm_jacobian(params), evidence_weight(reduced.noise_px)
    return weight * (T.T @ (reduced.H @ T)), weight * (T.T @ reduced.g), priors.prior_offsets(params)


def evidence_weight(noise_px: float) -> float:
    """Return the weight of a squared residual in pixels in the log-likelihood."""
    return 1.0 / (MISFIT * noise_px) ** 2


def _estimate(
    params: FloatArray, reduced: ReducedSystem, priors: lens_parts.LensPriors, free: BoolArray
) -> LensEstimate:
    """Return the most probable cameras for a choice of freed parts (C, 8), without a ranking."""
    H, g, offsets = _weigh(params, reduced, priors)
    T = _logarithm_jacobian(params)
    precision = priors.precision(free)
    mean, covariance = _posterior(H, g, precision, offsets, np.ones_like(offsets, np.bool_))
    determined = priors.estimated & _find_determined(covariance, precision, priors)
    changing = priors.parameter_mask(determined | (priors.estimated & ~priors.part_mask("stays")) | priors.required)
    zero = priors.parameter_mask(priors.estimated & ~free & priors.part_mask("exact"))
    zero[:, [FX, FY]] = False
    step, step_covariance = _posterior(H, g, np.where(zero, OPTIONS.zero_precision, 1.0) * precision, offsets, changing)
    squares = _mean_squares(step, (mean, covariance), precision, offsets, priors)
    photos = evidence_weight(reduced.noise_px) * (reduced.scores @ T)
    by_photo = _multiply(photos, covariance) @ T.T
    mean_squares = np.asarray((T @ squares) @ T.T, np.float64)
    variances = np.maximum(np.einsum("ii->i", mean_squares), np.sum(by_photo**2, axis=0))
    deviations = (
        np.sqrt(variances).reshape(params.shape)
        * np.where(priors.estimated.all(axis=1), 1.0, OPTIONS.few_photos)[:, None]
    )
    largest = np.abs(step) / np.sqrt(np.diag(step_covariance), out=np.ones_like(step), where=(changing & ~zero).ravel())
    largest = np.where(zero.ravel(), 0.0, largest)
    moved, held = _apply_step(params, step.reshape(params.shape), priors.sides)
    moved[zero] = priors.usual[zero]
    moved[priors.fixed], held[priors.fixed], deviations[priors.fixed] = params[priors.fixed], False, 0.0
    prior = priors.precision(np.ones((len(params), lens_parts.COUNT), np.bool_)) ** -0.5
    prior[:, [FX, FY]] = lens_parts.FOCAL_SPREAD * params[:, [FX, FY]]
    undetermined = priors.parameter_mask(priors.estimated) & ~changing
    deviations[held] = np.maximum(deviations[held], prior[held])
    # photos make no part less certain than its prior: a larger deviation is rounding, where nearly all of H cancels
    deviations[undetermined] = np.minimum(deviations, np.hypot(prior, offsets))[undetermined]
    determined[held] = False
    blocks = np.einsum("iaib->iab", mean_squares.reshape(2 * params.shape))
    own_squares = blocks * (~held & ~priors.fixed)[:, None, None]
    return LensEstimate(
        np.where(held[:, None], params, moved), deviations, own_squares, free & determined, determined,
        float(np.max(largest.reshape(params.shape)[~held & ~priors.fixed], initial=0.0)), held, (), held,
    )  # fmt: skip


def _posterior(
    H: FloatArray, g: FloatArray, precision: FloatArray, offsets: FloatArray, changing: BoolArray
) -> tuple[FloatArray, FloatArray]:
    """Return mean step (12C,) and covariance (12C, 12C) of the parameters in `changing` (C, 12); 0 elsewhere."""
    places = np.flatnonzero(changing)
    step, covariance = np.zeros(len(g)), np.zeros_like(H)
    block = np.ix_(places, places)
    covariance[block] = inverse_of_positive((H + np.diag(precision.ravel()))[block])
    step[places] = _multiply(covariance[block], (g + (precision * offsets).ravel())[places])
    return step, covariance


def _find_determined(covariance: FloatArray, precision: FloatArray, priors: lens_parts.LensPriors) -> BoolArray:
    narrower = np.sqrt(np.diag(covariance)).reshape(precision.shape) < OPTIONS.undetermined_share * precision**-0.5
    rows = [
        [row[list(part.places)].all() for part in lens_parts.PARTS[int(kind)]]
        for row, kind in zip(narrower, priors.family, strict=True)
    ]
    return np.array(rows, np.bool_).reshape(-1, lens_parts.COUNT)


def _choose(
    H: FloatArray, g: FloatArray, offsets: FloatArray, priors: lens_parts.LensPriors
) -> tuple[BoolArray, tuple[tuple[LensChoice, ...], ...]]:
    """Return the most probable choice (C, 8), and the ranking of `LensEstimate`.

    One sweep asks all cameras, with the choices for the others from before the sweep. Asking one after the other, as
    `selfcal.priors` does, takes a posterior of all cameras for each, which is too slow for hundreds.
    """
    free, everything = np.zeros((len(offsets), lens_parts.COUNT), np.bool_), np.ones_like(offsets, np.bool_)
    ranking: list[tuple[LensChoice, ...]] = []
    for _ in range(OPTIONS.sweeps):
        before, precision, ranking = free, priors.precision(free), []
        step, covariance = _posterior(H, g, precision, offsets, everything)
        free = np.empty_like(before)
        for camera, own in enumerate(np.arange(len(g)).reshape(offsets.shape)):
            choices = priors.choices[camera]
            likelihood = cavity(covariance[np.ix_(own, own)], step[own], precision[camera], offsets[camera])
            evidence = posteriors(*likelihood, priors.choice_priors(choices, camera, offsets[camera])).log_evidence
            free[camera] = choices[np.argmax(evidence)]
            ranking.append(_rank(int(priors.family[camera]), choices, evidence))
        if np.array_equal(free, before):
            break
    return free, tuple(ranking)


def _rank(family: int, choices: BoolArray, log_evidence: FloatArray) -> tuple[LensChoice, ...]:
    best: dict[str, LensChoice] = {}
    for k in np.argsort(-log_evidence, kind="stable"):
        free = lens_parts.part_names(family, choices[k])
        name = lens_parts.model_name(family, free)
        best.setdefault(name, LensChoice(name, free, float(log_evidence[k])))
    return tuple(best.values())


def _mean_squares(
    step: FloatArray, posterior: tuple[FloatArray, FloatArray], precision: FloatArray, offsets: FloatArray,
    priors: lens_parts.LensPriors,
) -> FloatArray:  # fmt: skip
    """Return (12C, 12C) mean squares of the cameras about a step, over all choices for each, the others as they are.

    Barred choices and parts that are not estimated count, too: not estimating a part makes it no better known.
    """
    mean, covariance = posterior
    squares = covariance + np.outer(mean - step, mean - step)
    for camera, own in enumerate(np.arange(len(step)).reshape(offsets.shape)):
        block = np.ix_(own, own)
        likelihood = cavity(covariance[block], mean[own], precision[camera], offsets[camera])
        choices = priors.choice_priors(priors.consistent_choices(camera), camera, offsets[camera])
        squares[block] = posteriors(*likelihood, choices).mean_squares(step[own])
    return squares


def _logarithm_jacobian(params: FloatArray) -> "sparse.csr_array":
    """Return (12C, 12C) derivatives of the parameters by those with log f and log fy/fx in place of fx and fy."""
    from scipy import sparse

    T = sparse.eye_array(params.size, format="lil")
    for camera, values in enumerate(params):
        x, y = CAMERA * camera + FX, CAMERA * camera + FY
        T[x, x], T[x, y] = values[FX], -0.5 * values[FX]
        T[y, x], T[y, y] = values[FY], 0.5 * values[FY]
    return T.tocsr()


def _multiply(A: FloatArray, B: FloatArray) -> FloatArray:
    """Return A B without BLAS, whose sums depend on its threads."""
    return np.asarray(np.einsum("ij,j...->i...", A, B), np.float64)


def _apply_step(params: FloatArray, step: FloatArray, sides: FloatArray) -> tuple[FloatArray, BoolArray]:
    """Return the cameras (C, 12) after a step, and (C,) those that it makes diverge."""
    with np.errstate(over="ignore", invalid="ignore"):
        moved = lens_parts.step_cameras(params, step)
        focals = moved[:, [FX, FY]] / sides[:, None]
    low, high = OPTIONS.focals
    is_plausible = np.isfinite(moved).all(axis=1) & np.all((focals > low) & (focals < high), axis=1)
    return moved, ~is_plausible | (np.abs(step[:, lens_parts.LOG_FOCAL]) > OPTIONS.longest_step)


def _shorten_step(before: FloatArray, after: FloatArray, camera: int, priors: lens_parts.LensPriors) -> FloatArray:
    """Return a camera (12,) between two that does not fold; the second where the first folds, too."""
    if priors.folds(camera, before):
        return after
    halves = (before + 0.5**k * (after - before) for k in range(1, OPTIONS.clamps + 1))
    return next((one for one in halves if not priors.folds(camera, one)), before)


def divide_by_focal(bundle: Bundle, priors: lens_parts.LensPriors) -> IndexArray:
    """Return (I,) the number of each photo's camera: divided where other focal lengths explain its photos much better.

    They are of two devices, or each of its own: a zoom. Independent noise decides which, as it favors the second; the
    division must pay in spite of the usual misfit.
    """
    H, g = _focal_likelihood(bundle, priors)

    def weigh(numbers: IndexArray, misfit: float) -> tuple[float, FloatArray]:
        return _weigh_groups(H / misfit**2, g / misfit**2, numbers)

    alone, numbers = weigh(np.arange(len(g)), MISFIT)[1], bundle.camera.copy()
    for camera in range(len(bundle.params)):
        members = np.flatnonzero(numbers == camera)
        if np.ptp(alone[members]) < OPTIONS.least_change:
            continue
        divisions = [numbers.copy() for _ in members]
        divisions[0][members[1:]] = numbers.max() + np.arange(1, len(members))
        order = members[np.argsort(alone[members], kind="stable")]
        for cut, division in enumerate(divisions[1:], start=1):
            division[order[cut:]] = numbers.max() + 1
        best = max(divisions, key=lambda one: weigh(one, 1.0)[0])
        if weigh(best, MISFIT)[0] >= weigh(numbers, MISFIT)[0] + OPTIONS.divide_log_odds:
            numbers = best
    return numbers


def _focal_likelihood(bundle: Bundle, priors: lens_parts.LensPriors) -> tuple[FloatArray, FloatArray]:
    """Return H (I, I) and g (I,) of changes of each photo's log f, for noise alone; all else follows."""
    photos, shared = len(bundle.R), bundle.params.size
    rows = np.arange(photos)
    own = replace(bundle, params=bundle.params[bundle.camera], camera=rows, family=bundle.family[bundle.camera])
    reduced = reduce(replace(own, fixed=None), bundle_scale(bundle))
    T = _logarithm_jacobian(own.params)
    # a parameter of a camera is that of all its photos; their own focals follow
    column = np.concatenate([(CAMERA * bundle.camera[:, None] + np.arange(CAMERA)).ravel(), shared + rows])
    row = np.concatenate([np.arange(own.params.size), CAMERA * rows + lens_parts.LOG_FOCAL])
    H, g = np.zeros((shared + photos, shared + photos)), np.zeros(shared + photos)
    np.add.at(H, (column[:, None], column), (T.T @ (reduced.H @ T))[row[:, None], row] / reduced.noise_px**2)
    np.add.at(g, column, (T.T @ reduced.g)[row] / reduced.noise_px**2)
    H[range(shared), range(shared)] += priors.precision(np.ones_like(priors.estimated)).ravel()
    follow = solve_positive(H[:shared, :shared], np.column_stack([H[:shared, shared:], g[:shared]]))
    across = _multiply(H[shared:, :shared], follow)
    return H[shared:, shared:] - across[:, :-1], g[shared:] - across[:, -1]


def _weigh_groups(H: FloatArray, g: FloatArray, numbers: IndexArray) -> tuple[float, FloatArray]:
    """Return the log-evidence of one change of log f per group, up to a constant, and (I,) the most probable ones."""
    _, group = np.unique(numbers, return_inverse=True)
    count = int(group.max()) + 1
    S = np.zeros((count, count))
    np.add.at(S, (group[:, None], group), H)
    prior = NormalPriors(np.full((1, count), OPTIONS.own_focal**-2.0), np.zeros((1, count)), np.zeros(1))
    found = posteriors(S, np.asarray(np.bincount(group, g), np.float64), prior)
    return float(found.log_evidence[0]), found.steps[0, group]


def suggests_other_family(params: FloatArray, family: int, reach: float, best: LensChoice, folding: bool) -> bool:
    """Return whether a camera is worth trying as one of the other family.

    A perspective lens is, if it needs many terms, would fold, or puts the outermost points far inwards. A fisheye is,
    if a perspective lens can show its narrow view. `reach` is the radius of the outermost observations, in focal
    lengths; `folding` tells whether a more probable lens folds inside the photo.
    """
    if family == PANORAMA:
        return False
    angle = angle_limit(params, family, reach)
    if family == FISHEYE:
        return bool(angle < OPTIONS.narrow_angle)
    return folding or "k3" in best.free or bool(np.isnan(angle) or reach < OPTIONS.squeeze * np.tan(angle))


def convert_lens(params: FloatArray, family: int, reach: float) -> FloatArray | None:
    """Return the camera (12,) of the other family that shows rays at nearly the same radius; None if there is none.

    Both agree up to the radius `reach` in focal lengths. Center and aspect are kept, and tangential terms are dropped.
    """
    for share in np.linspace(1.0, OPTIONS.least_reach, 9):
        angle = angle_limit(params, family, float(share * reach))
        if np.isfinite(angle):
            break
    else:
        return None
    angles = np.linspace(0.0, angle, OPTIONS.samples + 1)[1:]
    places, base = ((K1, K2, K3, K4), angles) if family == PERSPECTIVE else ((K1, K2, K3), np.tan(angles))
    terms = base[:, None] ** (2 * np.arange(len(places) + 1) + 1)
    size = np.linalg.norm(terms, axis=0)
    fitted = np.linalg.lstsq(terms / size, radius_at(angles, params, family), rcond=1e-10)[0] / size
    if not fitted[0] > 0.0:
        return None
    other = np.zeros(CAMERA)
    other[[FX, FY, CX, CY]] = params[[FX, FY, CX, CY]]
    other[[FX, FY]] *= fitted[0]
    other[list(places)] = fitted[1:] / fitted[0]
    return other


def family_evidence(cost_px2: float, noise_px: float, best: LensChoice) -> float:
    """Return the log-probability of a bundle with one of its cameras as it is, comparable between families."""
    return best.log_evidence - evidence_weight(noise_px) * cost_px2
