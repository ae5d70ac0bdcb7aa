"""The inner loop: draw, solve and score until something better than the best turns up."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sfm_app.jit import kernel
from sfm_app.ransac.minimal import MOST_MODELS, is_oriented, models_through
from sfm_app.ransac.sampling import RandomState, draw_uniform, draw_weighted, uniform
from sfm_app.ransac.scoring import Measure, penalty
from sfm_app.ransac.verification import Gate

FloatArray = NDArray[np.float64]


class Rules(NamedTuple):
    """How hypotheses are made."""

    sample_size: int
    """7 or 8, see `minimal`."""
    oriented: bool
    """Whether models that put a sampled point behind a camera are dropped."""
    guided_share: float
    """Share of the samples that are drawn by the priors, the others being uniform."""


@kernel
def next_better(
    points: FloatArray,
    cumulative: FloatArray,
    rules: Rules,
    measure: Measure,
    gate: Gate,
    to_beat: float,
    limit: int,
    state: RandomState,
    best: FloatArray,
) -> tuple[int, float]:
    """Draw samples until one of its models has a smaller penalty than `to_beat`.

    Args:
        points: (N, 4) matches in random order, N >= the sample size; twice over, (2 N, 4), for a gate with a random
            start, so that any N rows on end are all of them.
        cumulative: (N,) running sum of the priors p(v_i).
        rules: how samples are drawn and models made.
        measure: the penalty.
        gate: the test that a model has to pass.
        to_beat: best penalty so far.
        limit: most samples.
        state: random generator.
        best: (9,) set to the better model.

    Returns:
        Number of samples drawn, and the smaller penalty; `to_beat` itself if there was none.
    """
    share, count = rules.guided_share, cumulative.shape[0]
    sample = np.empty(rules.sample_size, dtype=np.int64)
    models = np.empty((MOST_MODELS, 9))
    for trial in range(1, limit + 1):
        guided = share > 0.0 and (share >= 1.0 or uniform(state) < share)
        if not (guided and draw_weighted(state, cumulative, sample)):
            draw_uniform(state, count, sample)
        score = to_beat
        for k in range(models_through(points, sample, models)):
            if rules.oriented and not is_oriented(points, sample, models[k]):
                continue
            start = int(uniform(state) * count) if gate.random_start else 0
            found = penalty(points, start, models[k], measure, score, gate)
            if found < score:
                score = found
                best[:] = models[k]
        if score < to_beat:
            return trial, score
    return limit, to_beat
