"""The readout of a rolling shutter, by bundle adjustment of poses, points, cameras and one number for all photos.

Ours. Bundle adjustment without it has hidden part of the shutter in poses, points and lens, so that residuals alone do
not tell it. Here every photo moves while it is read: along the path through its neighbors, and by an offset of its own,
because a hand shakes between two photos. How large offsets usually are, the photos say (MacKay 1992).
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from sfm_app.bundle_adjustment.elimination import POSE
from sfm_app.bundle_adjustment.lens_parts import LensPriors
from sfm_app.bundle_adjustment.normal_equations import USUAL_NOISE_PX, Bundle
from sfm_app.bundle_adjustment.path_velocity import path_velocities
from sfm_app.bundle_adjustment.shutter_equations import (
    ShutterBundle,
    ShutterStep,
    apply_shutter_step,
    linearize,
    shutter_cost,
    solve_step,
)

FloatArray = NDArray[np.float64]

STEPS, CONVERGED = 12, 1e-4
"""Most Gauss-Newton steps, and the relative decrease of the cost below which they end: after three to six. Chosen on
`python -m benchmarks.videos.shutter`."""
HALVINGS = 3
"""How often a step is halved that raises the cost. Chosen by hand; not measured on its own."""
LEAST_READOUT = 1e-5
"""Readout that offsets are expected for where it is smaller, as a share of the time between two photos: a precision of
offsets must be finite. Chosen by hand; not measured on its own."""
SHAKE = (0.2, 5.0)
"""Range of the size of offsets, in deviations of the path's velocities times readout. Above it, offsets of all photos
together bend the scene, and no readout is found. Chosen on `python -m benchmarks.videos.shutter`."""
LEAST_MEASURED = 3.0
"""Number of offsets that the photos must determine before their size is changed. Chosen by hand; not measured on its
own."""
SHAKE_CONVERGED = 1.1
"""Factor by which the size of offsets may still change when the steps end. Chosen by hand; not measured on its own."""


@dataclass(frozen=True, slots=True, eq=False)
class Rows:
    """When the observations of a bundle were seen."""

    times: FloatArray
    """(I,) of the photos, distinct: when the middle row was read."""
    share: FloatArray
    """(N,) row of each observation, from -1/2 to 1/2 in the order of reading."""


@dataclass(frozen=True, slots=True, eq=False)
class ReadoutEstimate:
    """The readout, and the model that goes with it."""

    readout: float
    """Time from the first row to the last, in the unit of the photos' times; negative where the last row is read
    first."""
    deviation: float
    """Its standard deviation; 0 where it was known."""
    bundle: Bundle
    """Poses are those of the middle rows."""
    motion: FloatArray
    """(I, 6) of each photo during the readout: velocity as in `PathVelocities`, times readout."""
    shake: FloatArray
    """(2,) size of the offsets of turns and moves, in deviations of the path's velocities times readout."""
    noise_px: float
    """Standard deviation of a coordinate."""


@dataclass(frozen=True, slots=True, eq=False)
class _Problem:
    """What does not change during the adjustment."""

    rows: Rows
    fits: NDArray[np.int64]
    """(2,) of turns and moves, see `PathVelocities`."""
    priors: LensPriors
    precision: FloatArray
    """(C, 12) of the priors on the cameras."""
    scale_px: float
    held: bool
    """Whether the readout is known."""


def estimate_readout(
    bundle: Bundle, rows: Rows, priors: LensPriors, freed: NDArray[np.bool_], scale_px: float,
    start: ReadoutEstimate | None = None, *, known: float | None = None,
) -> ReadoutEstimate:  # fmt: skip
    """Adjust poses, points, cameras and the readout together.

    Args:
        bundle: the model, adjusted as if a global shutter had taken its photos; nine or more.
        rows: when its observations were seen.
        priors: on the cameras.
        freed: (C, 7) parts of the cameras that have the wide prior.
        scale_px: as of `normal_equations.reduce`.
        start: an earlier estimate for the same photos, of which readout and shake are taken.
        known: the readout, if only poses and points are asked for.
    """
    fits = path_velocities(bundle.R, bundle.t, rows.times).select_most_predictive()
    problem = _Problem(rows, fits, priors, priors.precision(freed), scale_px, known is not None)
    readout, shake = (start.readout, start.shake) if start else (0.0, np.ones(2))
    model = _follow_path(ShutterBundle.motionless(bundle, rows.share, readout if known is None else known), problem)
    noise_px = USUAL_NOISE_PX
    for _ in range(STEPS):
        expected = _expected_offsets(model, problem, shake)
        terms = _prior_terms(model, expected, problem, noise_px)
        step = solve_step(linearize(model, *terms, scale_px, held=problem.held))
        noise_px = step.noise_px
        before = _cost(model, expected, problem, noise_px)
        model, after = _take_step(model, step, expected, problem, before)
        last, shake = shake, _update_shake(model.offsets / expected, step.offset_variances / expected**2, shake)
        if after >= (1.0 - CONVERGED) * before and np.abs(np.log(shake / last)).max() < np.log(SHAKE_CONVERGED):
            break
    return ReadoutEstimate(model.readout, step.deviation, model.bundle, model.motion, shake, noise_px)


def _follow_path(model: ShutterBundle, problem: _Problem) -> ShutterBundle:
    """Return the model with the velocities of its path."""
    path = path_velocities(model.bundle.R, model.bundle.t, problem.rows.times)
    return replace(model, velocity=path.select(problem.fits))


def _expected_offsets(model: ShutterBundle, problem: _Problem, shake: FloatArray) -> FloatArray:
    """Return standard deviations (I, 6) of the offsets.

    They are held during a step: if they grew with the readout, offsets would ask for a longer one.
    """
    times = problem.rows.times
    path = path_velocities(model.bundle.R, model.bundle.t, times)
    readout = max(abs(model.readout), LEAST_READOUT * float(np.median(np.diff(np.sort(times)))))
    return np.asarray(readout * path.deviations() * np.repeat(shake, 3), np.float64)


def _update_shake(offsets: FloatArray, variances: FloatArray, shake: FloatArray) -> FloatArray:
    """Return the size of offsets (2,) from what the photos determine of them.

    Args:
        offsets, variances: (I, 6) in expected deviations, and their squares.
        shake: (2,) that the expected deviations are based on.
    """
    measured = np.sum(1.0 - np.minimum(variances, 1.0).reshape(-1, 2, 3), axis=(0, 2))
    squares = np.sum(offsets.reshape(-1, 2, 3) ** 2, axis=(0, 2))
    factor = np.sqrt(squares / np.maximum(measured, LEAST_MEASURED))
    return np.clip(np.where(measured < LEAST_MEASURED, 1.0, factor) * shake, *SHAKE)


def _prior_terms(
    model: ShutterBundle, expected: FloatArray, problem: _Problem, noise_px: float
) -> tuple[FloatArray, FloatArray]:
    """Return precisions (n,) of the priors, in 1 / px^2, and precisions times distances to what they expect."""
    poses, away = np.zeros(POSE * len(model.bundle.R)), problem.priors.prior_offsets(model.bundle.params)
    precision = np.concatenate([poses, expected.ravel() ** -2.0, problem.precision.ravel(), [0.0]])
    distance = np.concatenate([poses, -model.offsets.ravel(), away.ravel(), [0.0]])
    return noise_px**2 * precision, noise_px**2 * precision * distance


def _take_step(
    model: ShutterBundle, step: ShutterStep, expected: FloatArray, problem: _Problem, before: float
) -> tuple[ShutterBundle, float]:
    """Return the model after the step, or after the part of it that lowers the cost, and its cost."""
    for k in range(HALVINGS + 1):
        tried = _follow_path(apply_shutter_step(model, step, 0.5**k), problem)
        after = _cost(tried, expected, problem, step.noise_px)
        if after < before:
            return tried, after
    return model, before


def _cost(model: ShutterBundle, expected: FloatArray, problem: _Problem, noise_px: float) -> float:
    """Return half the sum of the loss and of the squares of the priors, in squared pixels."""
    away = problem.priors.prior_offsets(model.bundle.params)
    squares = np.sum((model.offsets / expected) ** 2) + np.sum(problem.precision * away**2)
    return shutter_cost(model, problem.scale_px) + 0.5 * noise_px**2 * float(squares)
