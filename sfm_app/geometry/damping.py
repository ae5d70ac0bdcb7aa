"""Damping of Levenberg-Marquardt steps (Marquardt 1963), for every adjustment written in Python.

The kernels of `ransac.refine.sampson_refit` and `posegraph.refine`, and `selfcal.thesis.least_squares` with its many
simultaneous starts, do the same inside their loops.
"""

from collections.abc import Callable
from typing import NamedTuple, TypeVar

Trial = TypeVar("Trial")

INCREASE, DECREASE = 10.0, 0.1
"""Factors of the damping after a rejected and after an accepted step. The usual ones (Marquardt 1963)."""


class DampingRange(NamedTuple):
    """Damping relative to the diagonal of the normal equations."""

    first: float
    least: float
    most: float
    """No step is tried with this damping or more."""


def damped_step(
    attempt: Callable[[float], Trial | None], damping: float, limits: DampingRange
) -> tuple[Trial | None, float]:
    """Find a step that lowers the cost, raising the damping until one does.

    Args:
        attempt: takes a damping; returns the result of the step, or None if it does not lower the cost.
        damping: initial damping, > 0.
        limits: range of the damping.

    Returns:
        The result of the step, None if no step lowers the cost, and the damping for the next step.
    """
    while damping < limits.most:
        trial = attempt(damping)
        if trial is not None:
            return trial, max(DECREASE * damping, limits.least)
        damping *= INCREASE
    return None, damping
