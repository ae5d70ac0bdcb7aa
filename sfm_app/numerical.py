"""Errors of computations, finite values, JSON, local deviations, and a shared constant."""

import json
import math
from collections.abc import Mapping, Sequence
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from sfm_app.errors import NumericalError

Json: TypeAlias = "bool | int | float | str | Sequence[Json] | Mapping[str, Json] | None"
"""Values of JSON."""

FAILURES = (NumericalError, ArithmeticError, np.linalg.LinAlgError)
"""Errors of computations on degenerate input: a singular matrix, a division by zero, points on a line. A run continues
without an optional result. ValueError and IndexError are bugs, and end the run."""
MAD_TO_SIGMA = 1.4826
"""Standard deviation of a normal distribution over its median absolute deviation, 1 / Phi^-1(3/4) (Rousseeuw and Leroy
1987), with the digits that the thesis prints (5.7.2)."""


def error_reason(err: Exception) -> str:
    """Return the last line of an error's message; the name of its class without a message."""
    lines = str(err).strip().splitlines()
    return lines[-1] if lines else type(err).__name__


def finite_entries(values: Mapping[str, float | None]) -> dict[str, float]:
    """Return the finite entries."""
    return {name: value for name, value in values.items() if value is not None and np.isfinite(value)}


def local_deviation(gray: NDArray[np.uint8], side_px: int) -> NDArray[np.float32]:
    """Return (H, W) the standard deviation of gray levels (H, W) in the square of odd side around each pixel."""
    import cv2

    values, window = gray.astype(np.float32), (side_px, side_px)
    mean = cv2.blur(values, window)
    return np.asarray(np.sqrt(np.maximum(cv2.blur(values * values, window) - mean * mean, 0)), np.float32)


def json_text(value: Any) -> str:
    """Return plain values as JSON; infinities and NaN become null."""
    return json.dumps(_replace_nonfinite(value), indent=1, allow_nan=False) + "\n"


def _replace_nonfinite(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {key: _replace_nonfinite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_replace_nonfinite(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
