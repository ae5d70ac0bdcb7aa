"""The inner loop: draw, solve and score until a better model is found.

Thesis 4.7.5, lines 3 to 6 of Algorithm 1.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sfm_app.jit import kernel
from sfm_app.ransac.sampling.minimal_samples import RandomState, draw_uniform, draw_weighted, uniform
from sfm_app.ransac.scoring.robust_costs import Loss, penalty
from sfm_app.ransac.solvers.minimal import MOST_MODELS, is_oriented, solve_sample
from sfm_app.ransac.verification.pretests import PreTest

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

GUIDED, UNGUIDED = range(2)
"""Kinds of samples: drawn by the priors (or any sample while there are no priors), and drawn without them."""


class SamplingPlan(NamedTuple):
    """How samples are drawn and models computed from them."""

    sample_size: int
    """7 or 8, see `solvers.minimal`."""
    oriented: bool
    """Whether models that put a sampled point behind a camera are dropped."""
    batch: int
    """Samples between two checks for a better model."""
    guided_share: float
    """Share of the samples that are drawn by the priors."""
    priors: FloatArray
    """(N,) running sum of the priors p(v_i)."""
    rest_share: float
    """Share of the samples drawn from the rest, matches that the best model does not explain; the others are
    uniform."""
    rest: FloatArray
    """(N,) running count of the matches in the rest."""


@kernel
def draw_until_better(
    points: FloatArray,
    draws: SamplingPlan,
    loss: Loss,
    pretests: tuple[PreTest, PreTest],
    to_beat: FloatArray,
    limit: int,
    state: RandomState,
    best: FloatArray,
) -> int:
    """Draw samples until a model has a smaller penalty than the best of its kind.

    Lines 4 to 6 of Algorithm 1. Samples drawn without the priors compete only among themselves: a second motion, or
    inliers that a wrong model took for outliers, would never win against samples that the priors have made nearly
    perfect.

    Args:
        points: (N, 4) matches in random order, N >= the sample size; repeated to (2 N, 4) for a pre-test with a random
            start, so that any N consecutive rows hold all matches.
        draws: how samples are drawn and models computed.
        loss: the penalty.
        pretests: the tests that a model has to pass, by the kind of its sample: `GUIDED`, `UNGUIDED`.
        to_beat: (2,) smallest penalty so far of each kind; lowered.
        limit: largest number of samples.
        state: random generator.
        best: (2, 9) set to the better models.

    Returns:
        Number of samples drawn.
    """
    count = draws.priors.shape[0]
    sample = np.empty(draws.sample_size, dtype=np.int64)
    models = np.empty((MOST_MODELS, 9))
    better = False
    for trial in range(1, limit + 1):
        kind = draw_sample(draws, state, sample)
        pretest = pretests[kind]
        for k in range(solve_sample(points, sample, models)):
            if draws.oriented and not is_oriented(points, sample, models[k]):
                continue
            start = int(uniform(state) * count) if pretest.random_start else 0
            found = penalty(points, start, models[k], loss, to_beat[kind], pretest)
            if found < to_beat[kind]:
                to_beat[kind], better = found, True
                for j in range(9):
                    best[kind, j] = models[k, j]
        if better and trial % draws.batch == 0:
            return trial
    return limit


@kernel
def draw_sample(draws: SamplingPlan, state: RandomState, sample: IntArray) -> int:
    """Draw one sample by the priors, from the rest, or uniformly, and return its kind.

    A random number chooses among the three. Samples are uniform, too, while there are no priors, and where too few
    matches hold nearly all the weight.

    Args:
        draws: the shares of the three, and the weights.
        state: random generator.
        sample: (m,) filled with indices.
    """
    guided = draws.guided_share
    guided_or_rest = guided + draws.rest_share if draws.rest[-1] >= draws.sample_size else guided
    lot = uniform(state) if 0.0 < guided < 1.0 else 0.0
    kind, drawn = GUIDED, False
    if lot < guided:
        drawn = draw_weighted(state, draws.priors, sample)
    elif guided > 0.0:
        kind = UNGUIDED
        drawn = lot < guided_or_rest and draw_weighted(state, draws.rest, sample)
    if not drawn:
        draw_uniform(state, draws.priors.shape[0], sample)
    return kind
