"""The parts of an estimator: sampler, solver, score, verifier, stopping rule, final fit.

They are the stages of thesis Figure 3.7 and section 4.4; each can be exchanged.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sfm_app.ransac.sampling.minimal_samples import SAMPLE_SIZE, RandomState
from sfm_app.ransac.scoring.robust_costs import Loss, Score
from sfm_app.ransac.verification.pretests import FullVerification, PreTest, Verifier

FloatArray = NDArray[np.float64]

Refine = Callable[[FloatArray, FloatArray, float], FloatArray]
"""(points, F, threshold) -> a better F."""
Recover = Callable[[FloatArray, FloatArray, float, Loss, PreTest, RandomState], FloatArray | None]
"""(points, F, threshold, loss, pre-test, random generator) -> an F that the samples may have missed, or None."""
Validity = Callable[[FloatArray, FloatArray, float], FloatArray]
"""(points, f, threshold) -> p(v_i), (N,) >= 0, at least one of them > 0."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Recipe:
    """One estimator: sampler, solver, score, verifier, stopping rule, final fit."""

    score: Score
    """The penalty to minimize (see `scoring.robust_costs` and `scoring.mlesac`)."""
    finish: Refine
    """The final fit, from the best model of the loop."""
    sample_size: int = SAMPLE_SIZE
    """7: all models through seven matches; 8: the linear model through eight matches."""
    validity: Validity | None = None
    """Priors from a new best model; None: all samples are uniform."""
    guided_share: float = 1.0
    """Share of the samples that are drawn by the priors."""
    rest_share: float = 0.0
    """Share of the samples that are drawn from matches that the best model does not explain, once there are priors."""
    batch: int = 1
    """Samples between two checks for a better model."""
    warmup_share: float = 0.0
    """Share of the trials before the first priors."""
    verifier: Callable[[int, int], Verifier] = FullVerification
    """(number of matches, sample size) -> the test that hypotheses take before they are scored in full."""
    assumed_share: float | None = None
    """Share of inliers for the number of trials (thesis 3.19); None: that of the best model."""
    least_trials: int = 0
    """Samples that are drawn in any case, even if (3.19) needs fewer, and before the first call of `patience`."""
    stop_on_convergence: bool = False
    """End when the priors have converged (thesis 4.18)."""
    patience: Callable[[FloatArray, FloatArray, float], float] | None = None
    """(points, F, threshold) -> samples without a better model that end the search (see `sampling.termination`)."""
    improve: Refine | None = None
    """Local optimization of every new best model of a sample."""
    fine_score: Score | None = None
    """The penalty that ranks locally optimized models; None: `score` ranks them, too."""
    recover: Recover | None = None
    """A last attempt from the best model, by means other than samples of matches."""
    oriented: bool = False
    """Drop models that put a sampled point behind a camera before they are scored."""
