"""Levenberg and Marquardt's damping (Marquardt 1963), for every adjustment that is written in Python.

The kernels of `ransac.refine.sampson_refit` and the many starts at once of `selfcal.thesis.least_squares` do the same
inside their loops.
"""

from collections.abc import Callable
from typing import NamedTuple, TypeVar

Trial = TypeVar("Trial")

MORE, LESS = 10.0, 0.1
"""Factors after a step that fails, and after one that is taken. The usual ones (Marquardt 1963)."""


class DampingRange(NamedTuple):
    """Damping relative to the diagonal of the normal equations."""

    first: float
    least: float
    most: float
    """From here on no step is tried."""


def damped_step(
    attempt: Callable[[float], Trial | None], damping: float, limits: DampingRange
) -> tuple[Trial | None, float]:
    """Find a step that lowers the cost, damped as far as that needs.

    Args:
        attempt: takes a damping; gives what the step leads to, or None where it does not lower the cost.
        damping: to begin with, > 0.
        limits: between which it stays.

    Returns:
        What the step leads to, None where none is good, and the damping for the next.
    """
    while damping < limits.most:
        trial = attempt(damping)
        if trial is not None:
            return trial, max(LESS * damping, limits.least)
        damping *= MORE
    return None, damping
