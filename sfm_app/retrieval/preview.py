"""A glance at two photos before they are matched: do their largest features match (Wu 2013)?

The few largest features tell whether two photos overlap, at a hundredth of the cost of matching all of them.
"""

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

DescriptorArray = NDArray[np.uint8]

MAX_RATIO = 0.8
"""Largest ratio of the distances to the nearest and the second nearest descriptor (Lowe 2004)."""


def count_preview_matches(first: DescriptorArray, others: Sequence[DescriptorArray]) -> list[int]:
    """Count the features of a photo and of each other photo that are each other's nearest, and clearly so.

    Args:
        first: (N, 128) descriptors of the largest features of the photo.
        others: (M, 128) of each other photo.
    """
    if not others or not len(first):
        return [0] * len(others)
    a, b = first.astype(np.float32), np.concatenate(others).astype(np.float32)
    squares = a @ b.T  # whole numbers below 2^24: exact, whatever the order of summation
    squares *= -2.0
    squares += np.einsum("nd,nd->n", a, a)[:, None]
    squares += np.einsum("md,md->m", b, b)
    ends = np.cumsum([0, *map(len, others)])
    return [_count_mutual(squares[:, start:end]) for start, end in pairwise(ends)]


def _count_mutual(squares: NDArray[np.float32]) -> int:
    """Count the rows of squared distances (N, M) whose clear minimum is also that of its column; changes them."""
    if min(squares.shape) < 2:
        return 0
    rows, owners = np.arange(len(squares)), squares.argmin(axis=0)
    nearest = squares.argmin(axis=1)
    least = squares[rows, nearest]
    squares[rows, nearest] = np.inf
    return int(np.count_nonzero((least < MAX_RATIO**2 * squares.min(axis=1)) & (owners[nearest] == rows)))
