"""The loop of every estimator: draw, solve, pre-test, score, refine, stop (thesis 4.4, Figure 3.7 and Algorithm 1)."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from sfm_app.fundamental.points import Matches
from sfm_app.fundamental.pretests import LENIENCE, NO_PRETEST, FullScoring, PreTest
from sfm_app.fundamental.samples import (
    SAMPLE_SIZE,
    RandomState,
    draw_uniform,
    draw_weighted,
    has_converged,
    random_state,
    uniform,
)
from sfm_app.fundamental.scores import Loss, Score, penalty, squared_distances
from sfm_app.fundamental.solvers import MOST_MODELS, is_oriented, solve_sample
from sfm_app.jit import kernel
from sfm_app.settings import EpipolarSettings
from sfm_app.types.arrays import FloatArray, IndexArray

Refine = Callable[[FloatArray, FloatArray, float], FloatArray]
"""(points, F, threshold) -> a better F."""
Recover = Callable[[FloatArray, FloatArray, float, Loss, RandomState], FloatArray | None]
"""(points, F, threshold, loss, random generator) -> an F that the samples may have missed, or None."""
Validity = Callable[[FloatArray, FloatArray, float], FloatArray]
"""(points, f, threshold) -> p(v_i), (N,) >= 0, at least one of them > 0."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Recipe:
    """One estimator: score, final fit, samples and their priors, pre-test, stopping rules and local optimization."""

    score: Score
    finish: Refine
    sample_size: int = SAMPLE_SIZE
    """7: all models through seven matches; 8: the linear model through eight."""
    validity: Validity | None = None
    """Priors from a new best model; None: all samples are uniform."""
    guided_share: float = 1.0
    """Share of the samples that are drawn by the priors."""
    rest_share: float = 0.0
    """Share of the samples drawn from matches beyond two thresholds of the best model, once there are priors."""
    batch: int = 1
    """Samples between two checks for a better model."""
    warmup_share: float = 0.0
    """Share of the trials before the first priors."""
    pretest: Callable[[int, int], FullScoring] = FullScoring
    """(number of matches, sample size) -> the pre-test of hypotheses."""
    assumed_share: float | None = None
    """Share of inliers for the number of trials (thesis 3.19); None: that of the best model."""
    least_trials: int = 0
    """Least number of samples, also if (3.19) needs fewer, and before the first call of `patience`."""
    stop_on_convergence: bool = False
    """End when the priors have converged (thesis 4.18)."""
    patience: Callable[[FloatArray, FloatArray, float], float] | None = None
    """(points, F, threshold) -> samples without a better model that end the search."""
    improve: Refine | None = None
    """Local optimization of every new best model of a sample."""
    fine_score: Score | None = None
    """The penalty that ranks locally optimized models; None: `score` ranks them, too."""
    recover: Recover | None = None
    """A last attempt from the best model, by means other than samples of matches."""
    oriented: bool = False
    """Drop models that put a sampled point behind a camera before they are scored."""


GUIDED, UNGUIDED = range(2)
"""Kinds of samples: drawn by the priors (or any sample while there are no priors), and drawn without them."""


class SamplingPlan(NamedTuple):
    """How samples are drawn and models computed from them."""

    sample_size: int
    oriented: bool
    batch: int
    guided_share: float
    priors: FloatArray
    """(N,) running sum of the priors p(v_i)."""
    rest_share: float
    """Share of the samples drawn from the rest, matches that the best model does not explain; others are uniform."""
    rest: FloatArray
    """(N,) running count of the matches in the rest."""


@kernel
def draw_until_better(  # noqa: PLR0913
    points: FloatArray,
    draws: SamplingPlan,
    loss: Loss,
    pretests: tuple[PreTest, PreTest],
    to_beat: FloatArray,
    limit: int,
    state: RandomState,
    best: FloatArray,
) -> int:
    """Draw samples until a model has a smaller penalty than the best of its kind; return their number.

    Lines 4 to 6 of Algorithm 1. Samples drawn without the priors compete only among themselves: a second motion would
    never win against samples that the priors have made nearly perfect.

    For a pre-test with a random start, the points are repeated to (2 N, 4), so that any N consecutive rows hold all
    matches. `to_beat` (2,), the smallest penalties so far, is lowered, and `best` (2, 9) set to the better models.
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
            score = penalty(points, start, models[k], loss, to_beat[kind], pretest)
            if score < to_beat[kind]:
                to_beat[kind], best[kind], better = score, models[k], True
        if better and trial % draws.batch == 0:
            return trial
    return limit


@kernel
def draw_sample(draws: SamplingPlan, state: RandomState, sample: IndexArray) -> int:
    """Draw one sample (m,) by the priors, from the rest, or uniformly; return its kind. Uniform if others fail."""
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


class BestModel:
    """The best model so far, and the penalties that the next one has to beat: F* and Q* of Algorithm 1."""

    f: FloatArray
    """(9,) entries of F, norm 1; F* of the thesis."""
    to_beat: FloatArray
    """(2,) bars, one per kind of sample: penalties that models must stay below (see `draw_until_better`)."""
    samples: FloatArray
    """(2, 9) for each kind, the last model of a sample that was below the bar."""

    def __init__(self, points: FloatArray, threshold: float, recipe: Recipe) -> None:
        self._points, self._threshold, self._recipe = points, threshold, recipe
        self.loss = recipe.score(points, threshold, None)
        self._fine = None if recipe.fine_score is None else recipe.fine_score(points, threshold, None)
        self.f, self._lowest = np.zeros(9), math.inf
        self.to_beat, self.samples = np.full(2, math.inf), np.zeros((2, 9))

    def __bool__(self) -> bool:
        return self._lowest < math.inf

    @property
    def final_loss(self) -> Loss:
        """The loss that ranks locally optimized models."""
        return self._fine or self.loss

    def inlier_share(self) -> float:
        """Return the share of all matches that are within the threshold."""
        return float(np.mean(squared_distances(self._points, self.f) <= self._threshold**2))

    def update(self, kind: int) -> bool:
        """Update the best model and the bars with the sample below the bar of its kind; return whether it changed.

        With one score the sample is the new best model, and its penalty the bar of both kinds. With two scores its
        model is locally optimized and has to win by the finer score; each kind then has a bar of its own.
        """
        if self._fine is None:
            self._replace(self.samples[kind].copy(), float(self.to_beat[kind]))
            self.to_beat[:] = self._lowest
            return True
        if not self.replace_if_better(self.samples[kind].reshape(3, 3)):
            return False
        # unguided samples need `LENIENCE` of the support of the best guided one: the penalty saved by its inliers
        worst = len(self._points) * self.loss.worst
        self.to_beat[UNGUIDED] = worst - LENIENCE * (worst - self.to_beat[GUIDED])
        return True

    def _replace(self, model: FloatArray, score: float) -> None:
        """Replace the best model by that of a sample, locally optimized where this lowers the penalty."""
        self.f, self._lowest = model, score
        if self._recipe.improve is not None:
            improved = self._improve(model.reshape(3, 3))
            improved_score = penalty(self._points, 0, improved, self.loss, math.inf, NO_PRETEST)
            if improved_score < score:
                self.f, self._lowest = improved, improved_score
        # the penalty of MLESAC depends on the best model; comparing penalties across the change is not always sensible
        # (thesis 4.6)
        loss = self._recipe.score(self._points, self._threshold, self.f)
        if loss != self.loss:
            self.loss, self._lowest = loss, penalty(self._points, 0, self.f, loss, math.inf, NO_PRETEST)

    def replace_if_better(self, F: FloatArray) -> bool:
        """Replace the best model by the optimized F if its finer penalty is lower; return whether it is."""
        improved = self._improve(F)
        score = penalty(self._points, 0, improved, self.final_loss, self._lowest, NO_PRETEST)
        if score < self._lowest:
            self.f, self._lowest = improved, score
            return True
        return False

    def _improve(self, F: FloatArray) -> FloatArray:
        if self._recipe.improve is not None:
            F = self._recipe.improve(self._points, F, self._threshold)
        return np.asarray(np.ascontiguousarray(F).reshape(9) / np.linalg.norm(F))


@dataclass(frozen=True, slots=True, eq=False)
class Hypothesis:
    """The best model of a search, and the number of samples drawn."""

    F: FloatArray
    """(3, 3) in the frame of `Matches`."""
    trials: int


def run_loop(
    matches: Matches, options: EpipolarSettings, seed: int, recipe: Recipe, draw: Callable[..., int] = draw_until_better
) -> Hypothesis | None:
    """Draw samples by the priors until a stopping rule holds (thesis, Algorithm 1); None without a model."""
    if len(matches.points) < recipe.sample_size:
        return None
    return _Loop(matches, options, seed, recipe, draw).run()


class _Loop:
    """The state of Algorithm 1: the best model so far, and from it the priors and limits for the next samples."""

    share: float
    """Largest share of inliers of any best model so far, or the assumed one."""
    limit: int
    """Largest number of samples, by (3.19) and the settings."""
    warmup_trials: int
    patience: float
    """Samples without a better model after which the evidence for the best one is evaluated."""

    def __init__(
        self, matches: Matches, options: EpipolarSettings, seed: int, recipe: Recipe, draw: Callable[..., int]
    ) -> None:
        self.points, self.threshold = matches.points, options.max_error_px / matches.unit_px
        self.options, self.recipe, self.draw_until_better = options, recipe, draw
        self.adaptive = recipe.pretest(len(self.points), recipe.sample_size)
        self.best, self.share = BestModel(self.points, self.threshold, recipe), recipe.assumed_share or 0.0
        self.priors, self.state = np.ones(len(self.points)), random_state(seed)
        no_rest = np.zeros(1)
        equal = np.cumsum(self.priors)
        self.draws = SamplingPlan(recipe.sample_size, recipe.oriented, recipe.batch, 0.0, equal, 0.0, no_rest)
        random_start = self.adaptive.pretest.random_start
        self.circle = np.asfortranarray(np.vstack([self.points] * 2)) if random_start else self.points
        self.trials, self.idle, self.has_priors = 0, 0, False
        self.patience = recipe.least_trials if recipe.patience is not None else math.inf
        self._update_limits()

    def run(self) -> Hypothesis | None:
        while self.trials < self.limit:
            better = self._draw()
            if self._update_priors(better) or self._is_patience_over():
                break
        if not self.best:
            return None
        if self.recipe.recover is not None:
            self._recover(self.recipe.recover)
        return Hypothesis(self.best.f.reshape(3, 3), self.trials)

    def _recover(self, recover: Recover) -> None:
        """Replace the best model by one that the samples have missed, as long as that is better."""
        better = True
        while better:
            F = recover(self.points, self.best.f.reshape(3, 3), self.threshold, self.best.final_loss, self.state)
            better = F is not None and self.best.replace_if_better(F)

    def _draw(self) -> bool:
        """Draw samples until a better model or the next decision; return whether the best model changed."""
        most = min(self.limit - self.trials, self.adaptive.review, self.patience - self.idle)
        if self.trials < self.warmup_trials:
            most = min(most, self.warmup_trials - self.trials)
        best, before = self.best, self.best.to_beat.copy()
        pretests = self.adaptive.pretest, self.adaptive.lenient  # guided, unguided
        drawn = self.draw_until_better(
            self.circle, self.draws, best.loss, pretests, best.to_beat, int(most), self.state, best.samples
        )
        self.trials += drawn
        self.idle += drawn
        self.adaptive.learn(drawn)
        improved = np.flatnonzero(best.to_beat < before).tolist()
        better = any([best.update(kind) for kind in improved])  # noqa: C419  update both kinds
        if better:
            share = best.inlier_share()
            self.idle, self.share = 0, self.recipe.assumed_share or max(self.share, share)
            self.adaptive.expect(share)
            if self.recipe.patience is not None:
                self.patience = self.recipe.least_trials
        self._update_limits()
        return better

    def _update_limits(self) -> None:
        needed = max(self.adaptive.required_trials(self.share, self.options.confidence), self.recipe.least_trials)
        self.limit = math.ceil(min(self.options.max_trials, needed))
        self.warmup_trials = math.ceil(self.recipe.warmup_share * self.limit)

    def _update_priors(self, better: bool) -> bool:
        """Set the priors after a new best model; return whether they have converged and end the search."""
        recipe = self.recipe
        if recipe.validity is None or not self.best or self.trials < self.warmup_trials:
            return False
        if not better and self.has_priors:
            return False
        self.has_priors = True
        before, self.priors = self.priors, recipe.validity(self.points, self.best.f, self.threshold)
        self.draws = self.draws._replace(guided_share=recipe.guided_share, priors=np.cumsum(self.priors))
        if recipe.rest_share > 0:
            rest = squared_distances(self.points, self.best.f) > (2.0 * self.threshold) ** 2
            self.draws = self.draws._replace(rest_share=recipe.rest_share, rest=np.cumsum(rest, dtype=np.float64))
        return recipe.stop_on_convergence and has_converged(before, self.priors)

    def _is_patience_over(self) -> bool:
        """Return whether the best model has survived as many samples as its evidence requires."""
        if self.recipe.patience is None or self.idle < self.patience:
            return False
        if not self.best:
            self.patience += self.recipe.least_trials
            return False
        patience = self.recipe.patience(self.points, self.best.f.reshape(3, 3), self.threshold)
        if math.isinf(patience):  # support that may be chance must not guide the sampling
            self.draws = self.draws._replace(guided_share=0.0, rest_share=0.0)
        self.patience = math.ceil(min(patience, self.options.max_trials))
        return self.patience <= self.idle
