"""A plug-in of sfm-app to copy: one estimator of fundamental matrices, in NumPy alone.

`_find` is where a method of your own goes. The one that is here is plain: samples of eight matches, truncated squared
errors (MSAC, Torr and Zisserman 2000), and linear fits to what agrees.
"""

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from sfm_app.fundamental.estimate import estimate_with
from sfm_app.plugins import Estimator, hookimpl
from sfm_app.settings import EpipolarSettings
from sfm_app.types import EpipolarFit, Rejected

FloatArray = NDArray[np.float64]

SAMPLE = 8
"""Matches that a linear fit needs."""
REFITS = 5
"""Fits to the matches that agree."""
LEAST_EXTENT_PX = 1e-12
"""Of points that all lie in one place."""


@hookimpl
def sfm_estimators() -> Iterable[Estimator]:
    """Return what this plug-in adds: a name for the command line, a function, a line for `sfm-app plugins`."""
    return [Estimator("example-msac", fit_example, "MSAC with samples of eight matches; a template")]


def fit_example(x1: FloatArray, x2: FloatArray, options: EpipolarSettings, seed: int) -> EpipolarFit | Rejected:
    """Search with `_find`; sfm-app checks the matches before it, and judges the F after it."""
    return estimate_with(_find, x1, x2, options, seed)


def _find(x1: FloatArray, x2: FloatArray, options: EpipolarSettings, seed: int) -> tuple[FloatArray, int] | None:
    """Return F and how many samples were drawn, or None where there is no F. Same input and seed, same bytes."""
    if len(x1) < SAMPLE:
        return None
    rng = np.random.default_rng(seed % 2**64)  # any integer is a seed
    best: FloatArray | None = None
    least, trials, needed = np.inf, 0, options.max_trials
    while trials < needed:
        trials += 1
        rows = rng.choice(len(x1), SAMPLE, replace=False)
        F = _fit(x1[rows], x2[rows], np.ones(SAMPLE))
        cost, agree = _judge(F, x1, x2, options.max_error_px)
        if cost < least:
            best, least = F, cost
            needed = min(options.max_trials, _trials_needed(float(agree.mean()), options.confidence))
    if best is None:
        return None
    for _ in range(REFITS):
        _, agree = _judge(best, x1, x2, options.max_error_px)
        if agree.sum() < SAMPLE:
            break
        best = _fit(x1[agree], x2[agree], 1.0 / _slopes(best, x1[agree], x2[agree]))
    return best, trials


def _trials_needed(share: float, confidence: float) -> int:
    """Return after how many samples one is free of wrong matches, with that confidence."""
    clean = share**SAMPLE
    if clean == 1:
        return 1
    return int(min(np.ceil(np.log1p(-confidence) / np.log1p(-max(clean, 1e-12))), 1e12))


def _judge(F: FloatArray, x1: FloatArray, x2: FloatArray, max_error_px: float) -> tuple[float, NDArray[np.bool_]]:
    """Return the sum of truncated squared errors, and which matches agree."""
    distance = np.abs(np.sum(_homogeneous(x2) * (_homogeneous(x1) @ F.T), axis=1)) / _slopes(F, x1, x2)
    return float(np.sum(np.minimum(distance / max_error_px, 1.0) ** 2)), distance <= max_error_px


def _slopes(F: FloatArray, x1: FloatArray, x2: FloatArray) -> FloatArray:
    """Return what turns |x2' F x1| into Sampson's distance in pixels."""
    lines = np.hstack([(_homogeneous(x1) @ F.T)[:, :2], (_homogeneous(x2) @ F)[:, :2]])
    return np.asarray(np.maximum(np.linalg.norm(lines, axis=1), np.finfo(float).tiny))


def _fit(x1: FloatArray, x2: FloatArray, weights: FloatArray) -> FloatArray:
    """Return the F of rank 2 of a linear fit (eight-point algorithm, Hartley 1997)."""
    (n1, T1), (n2, T2) = _normalized(x1), _normalized(x2)
    rows = (n2[:, :, None] * n1[:, None, :]).reshape(-1, 9) * weights[:, None]
    _, vectors = np.linalg.eigh(rows.T @ rows)  # 9 x 9, however many matches there are
    U, s, V = np.linalg.svd(vectors[:, 0].reshape(3, 3))
    F = T2.T @ (U * [s[0], s[1], 0.0]) @ V @ T1
    return np.asarray(F / np.linalg.norm(F))


def _normalized(x: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return homogeneous points about the origin at a mean distance of sqrt(2), and the (3, 3) map to them."""
    middle = x.mean(axis=0)
    scale = np.sqrt(2) / max(float(np.linalg.norm(x - middle, axis=1).mean()), LEAST_EXTENT_PX)
    T = np.array([[scale, 0, -scale * middle[0]], [0, scale, -scale * middle[1]], [0, 0, 1]])
    return _homogeneous(x) @ T.T, T


def _homogeneous(x: FloatArray) -> FloatArray:
    return np.column_stack([x, np.ones(len(x))])
