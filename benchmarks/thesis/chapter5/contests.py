"""Run all calibrators on the same trials of an experiment: errors, answers and times per level."""

import sys
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor
from functools import partial
from typing import NamedTuple

import numpy as np

import sfm_app
from benchmarks.common.results import Row
from benchmarks.thesis.chapter5.fits import Fits, FloatArray
from benchmarks.thesis.chapter5.panels import round_significant
from benchmarks.thesis.chapter5.setups import Trial
from sfm_app.selfcal import pair_weights
from sfm_app.types import Calibration

PRODUCTION = "zero-curves"
WITHOUT_LENS = "zero-curves without a lens"
"""`zero-curves` with `calibration.lens = false`: the camera model of the VGG sequences' truth."""
ZERO_CURVES, MULTI_START, PERTURBATION = "zero-curves-thesis", "multi-start", "perturbation"
GEOMETRIC, NON_ROBUST, KRUPPA = "geometric", "huang-faugeras", "kruppa"
METHODS = (PRODUCTION, ZERO_CURVES, MULTI_START, PERTURBATION, GEOMETRIC, NON_ROBUST, KRUPPA)
CAP_PERCENT = 200.0
"""Errors are capped at this value, so that one diverged answer does not dominate a mean."""

Experiment = Callable[[int], Iterator[Trial]]


class Attempt(NamedTuple):
    """The result of one calibrator on one trial."""

    method: str
    x: float
    K: FloatArray | None
    """(3, 3) found camera matrix; None where there is no answer."""
    true_K: FloatArray
    ms: float


def calibrate(method: str, fits: Fits, size: tuple[int, int], seed: int) -> Calibration:
    """Run a calibrator by its name, with all that is known about the pairs."""
    lens = method != WITHOUT_LENS
    return sfm_app.calibrate_fundamentals(
        np.array([fit.F for fit in fits.values()]).reshape(-1, 3, 3),
        size,
        method if lens else PRODUCTION,
        weights=pair_weights([len(fit.matches) for fit in fits.values()]),
        matches=[fit.matches for fit in fits.values()],
        photos=list(fits),
        seed=seed,
        settings=sfm_app.Settings.from_mapping({"calibration": {"lens": lens}}),
    )


def answered_K(method: str, found: Calibration) -> FloatArray | None:
    """Return K; for a method of the thesis, which always answers, also the K that our verdict rejects."""
    if found.identifiable:
        return found.K
    told = [found.evidence.get(name) for name in ("fx_px", "fy_px", "cx_px", "cy_px")]
    if method in (PRODUCTION, WITHOUT_LENS) or None in told:
        return None
    fx, fy, cx, cy = told
    return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])


def e_focal(K: FloatArray, true_K: FloatArray) -> float:
    """Compute the mean error of fx and fy in percent of the truth (thesis 5.5.3)."""
    return float(50.0 * sum(abs(K[k, k] / true_K[k, k] - 1.0) for k in (0, 1)))


def e_center(K: FloatArray, true_K: FloatArray) -> float:
    """Compute e_OC, the mean error of the optical center's x and y in percent of the truth (thesis 5.5.3)."""
    return float(50.0 * sum(abs(K[k, 2] / true_K[k, 2] - 1.0) for k in (0, 1)))


def run_attempts(experiment: Experiment, methods: Sequence[str], seed: int) -> list[Attempt]:
    """Run the methods on all levels of one seed."""
    found = []
    for trial in experiment(seed):
        for method in methods:
            start = time.perf_counter()
            answer = calibrate(method, trial.fits, trial.size, seed)
            ms = 1e3 * (time.perf_counter() - start)
            found.append(Attempt(method, trial.x, answered_K(method, answer), trial.K, ms))
    return found


def run_contest(experiment: Experiment, tests: dict[str, int], seed: int, pool: Executor, title: str) -> list[Row]:
    """Return one row per method and level.

    Args:
        experiment: yields the trials of a seed; it must survive pickling.
        tests: number of seeds per method.
        seed: the first seed.
        pool: runs the seeds in parallel; apart from the times, the result does not depend on it.
        title: printed when it is done.
    """
    seeds = range(max(tests.values(), default=0))
    lists = [[name for name, count in tests.items() if n < count] for n in seeds]
    start = time.perf_counter()
    jobs = [
        pool.submit(partial(run_attempts, experiment, names, seed + n)) for n, names in zip(seeds, lists, strict=True)
    ]
    found = [attempt for job in jobs for attempt in job.result()]
    print(f"{title}: {len(seeds)} seeds in {time.perf_counter() - start:.0f} s", file=sys.stderr, flush=True)
    levels = sorted({attempt.x for attempt in found})
    return [
        summary(name, x, [attempt for attempt in found if attempt.method == name and attempt.x == x])
        for name in tests
        for x in levels
    ]


def summary(method: str, x: float, tries: Sequence[Attempt]) -> Row:
    """Return mean and median errors over the answers, and the share of answers."""
    answers = [(attempt.K, attempt.true_K) for attempt in tries if attempt.K is not None]
    row: Row = {
        "method": method,
        "x": round_significant(x),
        "tests": len(tries),
        "answered": len(answers) / max(len(tries), 1),
    }
    for title, error in (("e_focal", e_focal), ("e_OC", e_center)):
        errors = [min(error(K, true_K), CAP_PERCENT) for K, true_K in answers]
        row[title] = round_significant(float(np.mean(errors))) if errors else None
        row[f"{title} median"] = round_significant(float(np.median(errors))) if errors else None
    for name, entry in (("fx", (0, 0)), ("fy", (1, 1)), ("cx", (0, 2)), ("cy", (1, 2))):
        row[name] = round_significant(float(np.median([K[entry] for K, _ in answers]))) if answers else None
    return row | {"ms": round_significant(float(np.median([attempt.ms for attempt in tries])), 4) if tries else None}
