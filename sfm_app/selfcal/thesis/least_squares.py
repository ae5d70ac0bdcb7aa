"""Least squares over (fx, fy, u, v): the basis of all methods of the thesis but Zero Curves (5.6, 5.7).

The method `huang-faugeras` is the Huang-Faugeras constraint with equal weights: the thesis's "non-robust" one (5.5.3).
"""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import numpy as np

from sfm_app.selfcal.pairs import Pairs
from sfm_app.selfcal.thesis.constraint_forms import EQUATIONS, Equations, Halves
from sfm_app.selfcal.thesis.verdict import CameraParameters, calibrate_with
from sfm_app.settings import CalibrationSettings
from sfm_app.types import Calibration, CameraPairs
from sfm_app.types.arrays import FloatArray, IndexArray

METHOD = "huang-faugeras"
DEFAULT = EQUATIONS["huang-faugeras"]
"""The form that the thesis chooses (5.5.1)."""
FIRST_DAMPING = 1e-2
"""First damping of Levenberg-Marquardt steps, relative to the diagonal; by hand."""
DAMPING_RANGE = (1e-9, 1e9)
"""Least and largest damping; by hand."""
MOST_STEPS = 60
"""Most steps of one search; by hand."""
LONGEST_STEP = 0.5
"""Longest step in any parameter; the focals are logarithms; by hand."""
DIFFERENCE = 1e-7
"""Step of the parameters for finite differences: near the square root of double precision; by hand."""
FINISHED = 1e-9
"""A search whose step lowers the sum by a smaller share has converged; by hand."""


class Minima(NamedTuple):
    """Where the searches ended."""

    cameras: FloatArray
    """(B, 4) fx, fy, u, v."""
    sums: FloatArray
    """(B,) weighted sums of squares there."""


def fit_camera(
    pairs: Pairs, start: CameraParameters, weights: FloatArray, equations: Equations = DEFAULT
) -> CameraParameters:
    """Return the local minimum near `start` of sum_i w_i |equations_i|^2 / sum_i w_i over all pairs."""
    found = find_minima(
        Halves.from_fundamentals(pairs.F)[np.arange(len(pairs))[None]], weights[None], np.array([start]), equations
    )
    return CameraParameters(*(float(value) for value in found.cameras[0]))


def find_minima(halves: Halves, weights: FloatArray, starts: FloatArray, equations: Equations = DEFAULT) -> Minima:
    """Run Levenberg-Marquardt from many starts at once, each on its own pairs.

    Thesis (5.8) sums the terms; Levenberg-Marquardt, which the thesis minimizes it with, sums their squares. `halves`
    are (B, P) pairs with weights (B, P) of any scale; a start (B, 4) is fx, fy, u, v, with focals > 0.
    """
    scale = np.sqrt(weights / np.sum(weights, axis=1, keepdims=True))[..., None]

    def residuals(thetas: FloatArray, rows: IndexArray) -> FloatArray:
        values = scale[rows] * equations(halves[rows], _cameras(thetas)[:, None])
        return np.asarray(values.reshape(len(thetas), -1))

    thetas = np.column_stack([np.log(starts[:, :2]), starts[:, 2:]])
    searching = np.arange(len(thetas))
    sums = np.sum(residuals(thetas, searching) ** 2, axis=1)
    damping = np.full(len(thetas), FIRST_DAMPING)
    for _ in range(MOST_STEPS):
        trial = thetas[searching] + _step(partial(residuals, rows=searching), thetas[searching], damping[searching])
        before, after = sums[searching], np.sum(residuals(trial, searching) ** 2, axis=1)
        better = after < before
        thetas[searching[better]], sums[searching[better]] = trial[better], after[better]
        damping[searching] = np.clip(damping[searching] * np.where(better, 0.1, 10.0), *DAMPING_RANGE)
        arrived = np.where(better, before - after <= FINISHED * before, damping[searching] == DAMPING_RANGE[1])
        searching = searching[~arrived]
        if not len(searching):
            break
    return Minima(_cameras(thetas), sums)


def _step(residuals: Callable[[FloatArray], FloatArray], thetas: FloatArray, damping: FloatArray) -> FloatArray:
    """Return (B, 4) damped Gauss-Newton steps, with Marquardt's scaling."""
    here = residuals(thetas)
    moved = (residuals(thetas + DIFFERENCE * axis) for axis in np.eye(4))
    J = np.stack([(there - here) / DIFFERENCE for there in moved], axis=-1)
    normal = np.swapaxes(J, 1, 2) @ J
    gradient = np.einsum("bmk,bm->bk", J, here)
    diagonal = np.einsum("bkk->bk", normal)
    # invertible even where no equation depends on a parameter, which then stays
    least = np.finfo(np.float64).eps * (1.0 + np.max(diagonal, axis=1, keepdims=True))
    lifted = normal + (damping[:, None] * diagonal + least)[:, :, None] * np.eye(4)
    steps = np.linalg.solve(lifted, -gradient[..., None])[..., 0]
    return np.asarray(np.clip(steps, -LONGEST_STEP, LONGEST_STEP))


def _cameras(thetas: FloatArray) -> FloatArray:
    return np.column_stack([np.exp(thetas[:, :2]), thetas[:, 2:]])


def calibrate(pairs: CameraPairs, options: CalibrationSettings, seed: int) -> Calibration:
    """Minimize (5.8), or `constraint_form`, from K_init with equal weights; the given ones select pairs."""
    del seed
    return calibrate_with(METHOD, pairs, partial(_find_camera, equations=EQUATIONS[options.constraint_form]))


def _find_camera(pairs: Pairs, tall: float, evidence: dict[str, float], equations: Equations) -> CameraParameters:
    del evidence
    return fit_camera(pairs, CameraParameters.initial(tall), 0.0 * pairs.weights + 1.0, equations)
