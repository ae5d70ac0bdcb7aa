"""How parameters depend on each other, by their names."""

from collections.abc import Sequence
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

DIGITS = 4
"""Digits after the point that are kept: a correlation is not known more exactly."""


def correlation_key(first: str, second: str) -> str:
    """Return the name of a pair of parameters: their names with a space between.

    Args:
        first, second: names, in the order of the parameters.
    """
    return f"{first} {second}"


def named_correlations(names: Sequence[str], covariance: NDArray[np.float64]) -> dict[str, float]:
    """Return the correlation of each pair of parameters, from -1 to 1, by `correlation_key` in order of the names.

    Args:
        names: (n,) of the parameters.
        covariance: (n, n); parameters without a finite variance > 0 are left out.
    """
    variances = np.diag(covariance)
    known = [k for k in range(len(names)) if np.isfinite(variances[k]) and variances[k] > 0.0]
    found = {}
    for i, j in combinations(known, 2):
        value = float(covariance[i, j] / np.sqrt(variances[i] * variances[j]))
        if np.isfinite(value):
            found[correlation_key(names[i], names[j])] = round(float(np.clip(value, -1.0, 1.0)), DIGITS)
    return found
