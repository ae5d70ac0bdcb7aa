"""A glance at two photos before they are matched: do their largest features match (Wu 2013)?

The few largest features tell whether two photos overlap, at a hundredth of the cost of matching all of them.
"""

import numpy as np
from numpy.typing import NDArray

DescriptorArray = NDArray[np.uint8]

MAX_RATIO = 0.8
"""Largest ratio of the distances to the nearest and the second nearest descriptor (Lowe 2004)."""


def count_preview_matches(first: DescriptorArray, second: DescriptorArray) -> int:
    """Count the features of two photos that are each other's nearest, and clearly so.

    Args:
        first, second: (N, 128) and (M, 128) descriptors of the largest features.
    """
    if min(len(first), len(second)) < 2:
        return 0
    a, b = first.astype(np.float32), second.astype(np.float32)
    squares = np.einsum("nd,nd->n", a, a)[:, None] + np.einsum("md,md->m", b, b) - 2.0 * (a @ b.T)  # exact
    rows = np.arange(len(a))
    nearest = squares.argmin(axis=1)
    least = squares[rows, nearest]
    squares[rows, nearest] = np.inf
    clear = least < MAX_RATIO**2 * squares.min(axis=1)
    squares[rows, nearest] = least
    return int(np.count_nonzero(clear & (squares.argmin(axis=0)[nearest] == rows)))
