"""The point where most zero curves meet (thesis 5.8.4)."""

from typing import NamedTuple

import numpy as np

from sfm_app.jit import kernel
from sfm_app.selfcal.inputs import FloatArray


class Meeting(NamedTuple):
    """The sample of a curve that the other curves pass closest to."""

    sample: int
    """Index j* along the sweep."""
    value: float
    """Z_k*(j*)."""
    support: float
    """Mean of rho over the other curves there, in [0, 1]."""


def meeting_point(curves: FloatArray, upper: float, sigma: float) -> Meeting | None:
    """Thesis (5.33), with its argmin corrected to argmax: the sample with the most consensus among the other curves.

    Distance as in (5.34), the difference at the same sample of the sweep; rho(d) = exp(-d / sigma).

    Args:
        curves: (C, S) curves that are not degenerate.
        upper: only samples within (0, upper) can be the answer.
        sigma: one tenth of the range of the values.

    Returns:
        None where there are fewer than two curves, or no sample within the range.
    """
    if len(curves) < 2:
        return None
    scores = _scores(np.ascontiguousarray(curves), sigma)
    scores[(curves <= 0) | (curves >= upper)] = -1.0
    best = int(np.argmax(scores))
    k, j = divmod(best, curves.shape[1])
    if scores[k, j] < 0:
        return None
    return Meeting(j, float(curves[k, j]), float(scores[k, j]) / (len(curves) - 1))


@kernel
def _scores(curves: FloatArray, sigma: float) -> FloatArray:
    count, samples = curves.shape
    scores = np.zeros((count, samples))
    for k in range(count):
        for i in range(k):
            for j in range(samples):
                rho = np.exp(-abs(curves[k, j] - curves[i, j]) / sigma)
                scores[k, j] += rho
                scores[i, j] += rho
    return scores
