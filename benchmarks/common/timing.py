"""Run several estimators on the same pairs, alternating pair by pair, and time each call."""

import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]

Method = Callable[[FloatArray, FloatArray, int], tuple[FloatArray | None, int | None]]
"""(x1, x2, seed) -> F or None, and the number of samples where the method reports it."""


class Pair(Protocol):
    """The input of an estimator."""

    @property
    def x1(self) -> FloatArray:
        """(N, 2) pixels."""

    @property
    def x2(self) -> FloatArray:
        """(N, 2) pixels, matched to x1 row by row."""


@dataclass(frozen=True, slots=True, eq=False)
class Attempt:
    """The result of one method on one pair."""

    F: FloatArray | None
    """(3, 3), finite; None where the method returned no usable matrix."""
    ms: float
    trials: int | None


def take_turns(
    methods: Mapping[str, Method], pairs: Sequence[Pair], seed: int = 0, label: str = ""
) -> dict[str, list[Attempt]]:
    """Run all methods on all pairs; every method is first called once, unmeasured, to compile and load what it needs.

    Returns:
        Per method, one attempt for each pair. Pair n is estimated with `seed` + n.
    """
    attempts: dict[str, list[Attempt]] = {name: [] for name in methods}
    for method in methods.values():
        method(pairs[0].x1, pairs[0].x2, seed)
    for n, pair in enumerate(pairs):
        for name, method in methods.items():
            start = time.perf_counter()
            F, trials = method(pair.x1, pair.x2, seed + n)
            ms = 1e3 * (time.perf_counter() - start)
            attempts[name].append(Attempt(F if is_usable(F) else None, ms, trials))
        print(f"\r{label} {n + 1}/{len(pairs)}", end="", file=sys.stderr, flush=True)
    print(file=sys.stderr)
    return attempts


def is_usable(F: FloatArray | None) -> bool:
    """Return whether this is one finite, nonzero (3, 3) matrix."""
    return F is not None and F.shape == (3, 3) and bool(np.isfinite(F).all()) and bool(np.any(F))


def timing(attempts: Sequence[Attempt]) -> dict[str, float | None]:
    """Return milliseconds, and the mean number of samples where the method reports it."""
    ms = np.array([attempt.ms for attempt in attempts])
    trials = [attempt.trials for attempt in attempts if attempt.trials is not None]
    return {
        "ms median": round(float(np.median(ms)), 2),
        "ms mean": round(float(ms.mean()), 2),
        "ms p90": round(float(np.percentile(ms, 90)), 2),
        "ms total": round(float(ms.sum()), 1),
        "trials mean": round(float(np.mean(trials)), 1) if trials else None,
    }
