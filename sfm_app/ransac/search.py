"""The inner loop: draw, solve and score until something better than the best turns up."""

import numpy as np
from numpy.typing import NDArray

from sfm_app.jit import kernel
from sfm_app.ransac.minimal import MOST_MODELS, is_oriented, seven_point
from sfm_app.ransac.sampling import SAMPLE_SIZE, RandomState, draw_uniform, draw_weighted, uniform
from sfm_app.ransac.scoring import penalty

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]


@kernel
def next_better(
    points: FloatArray,
    cumulative: FloatArray,
    rules: tuple[float, bool, int],
    threshold: float,
    to_beat: float,
    least_inliers: IntArray,
    limit: int,
    state: RandomState,
    best: FloatArray,
) -> tuple[int, float]:
    """Draw samples until one of its models has a smaller penalty than `to_beat`.

    Args:
        points: (N, 4) matches in random order, N >= 7.
        cumulative: (N,) running sum of the priors p(v_i).
        rules: share of the samples that are drawn by the priors, the others being uniform; whether models that put a
            sampled point behind a camera are dropped; which penalty, see `scoring`.
        threshold: largest distance of an inlier.
        to_beat: best penalty so far.
        least_inliers: from `bail_out_table`; empty for no bail-out.
        limit: most samples.
        state: random generator.
        best: (9,) set to the better model.

    Returns:
        Number of samples drawn, and the smaller penalty; `to_beat` itself if there was none.
    """
    guided_share, oriented, kind = rules
    sample = np.empty(SAMPLE_SIZE, dtype=np.int64)
    models = np.empty((MOST_MODELS, 9))
    for trial in range(1, limit + 1):
        guided = guided_share > 0.0 and (guided_share >= 1.0 or uniform(state) < guided_share)
        if not (guided and draw_weighted(state, cumulative, sample)):
            draw_uniform(state, points.shape[0], sample)
        score = to_beat
        for k in range(seven_point(points, sample, models)):
            if oriented and not is_oriented(points, sample, models[k]):
                continue
            found = penalty(points, models[k], kind, threshold, score, least_inliers)
            if found < score:
                score = found
                best[:] = models[k]
        if score < to_beat:
            return trial, score
    return limit, to_beat
