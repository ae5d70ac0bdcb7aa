"""The design matrix A of the matches, row by row x2 (x) x1, and its products (thesis 2.27): x2' F x1 = 0 is A f = 0.

Matches are processed in blocks that fit in the first-level cache, each quantity contiguous, so that sums over matches
are vectorized.
"""

import numpy as np
from numpy.typing import NDArray

from sfm_app.jit import kernel, summing_kernel
from sfm_app.ransac.scoring.robust_costs import FIRST

FloatArray = NDArray[np.float64]

LANES = 64
"""Matches in a block. With the rows of A they take 7 kB. Chosen by hand for speed."""


@kernel
def design_row(point: FloatArray, row: FloatArray) -> None:
    """Write x2 (x) x1, the coefficients of the entries of F (by rows) in x2' F x1 = 0.

    Args:
        point: (4,) match x1, y1, x2, y2.
        row: (9,), written to.
    """
    for i in range(3):
        from2 = point[2 + i] if i < 2 else 1.0
        row[3 * i] = from2 * point[0]
        row[3 * i + 1] = from2 * point[1]
        row[3 * i + 2] = from2


@kernel
def gather(points: FloatArray, weights: FloatArray, start: int, block: FloatArray) -> tuple[int, int]:
    """Copy the next matches of positive weight, as columns x1, y1, x2, y2, sqrt(weight), to `block`.

    Args:
        points: (N, 4) matches.
        weights: (N,) >= 0.
        start: row to begin at.
        block: (5, LANES), written to.

    Returns:
        Number of columns filled, and the row to continue at.
    """
    filled, i = 0, start
    while i < points.shape[0] and filled < LANES:
        if weights[i] > 0.0:
            for k in range(4):
                block[k, filled] = points[i, k]
            block[4, filled] = np.sqrt(weights[i])
            filled += 1
        i += 1
    return filled, i


@kernel
def _design_columns(block: FloatArray, count: int, rows: FloatArray) -> None:
    """Write the rows of A for the matches of a block (see `gather`), times sqrt(weight), as columns (9, LANES)."""
    for n in range(count):
        x1, y1, x2, y2, root = block[0, n], block[1, n], block[2, n], block[3, n], block[4, n]
        rows[0, n], rows[1, n], rows[2, n] = x2 * x1 * root, x2 * y1 * root, x2 * root
        rows[3, n], rows[4, n], rows[5, n] = y2 * x1 * root, y2 * y1 * root, y2 * root
        rows[6, n], rows[7, n], rows[8, n] = x1 * root, y1 * root, root


@summing_kernel
def add_products(rows: FloatArray, count: int, gram: FloatArray) -> None:
    """Add the sums over n of rows[j, n] rows[k, n] to gram[j, k] for all k <= j.

    Args:
        rows: (9, LANES) columns of the design matrix, each contiguous.
        count: number of n, from 0 on.
        gram: (9, 9), added to.
    """
    for j in range(rows.shape[0]):
        for k in range(j + 1):
            total = 0.0
            for n in range(count):
                total += rows[j, n] * rows[k, n]
            gram[j, k] += total


@kernel
def mirror(gram: FloatArray) -> None:
    """Copy the lower triangle to the upper one."""
    for j in range(gram.shape[0]):
        for k in range(j):
            gram[k, j] = gram[j, k]


def weighted_gram(points: FloatArray, weights: FloatArray) -> FloatArray:
    """Return the (9, 9) matrix A' W A of the matches.

    Args:
        points: (N, 4) matches.
        weights: (N,) >= 0.
    """
    gram = np.zeros((9, 9))
    _add_gram(points, weights, gram)
    return gram


@kernel
def _add_gram(points: FloatArray, weights: FloatArray, gram: FloatArray) -> None:
    # gram.shape[0] instead of 9: if the size were known at compile time, the compiler would unroll all 45 sums
    block, rows = np.empty((5, LANES)), np.empty((gram.shape[0], LANES))
    start = FIRST
    while start < points.shape[0]:
        count, start = gather(points, weights, start, block)
        _design_columns(block, count, rows)
        add_products(rows, count, gram)
    mirror(gram)


@kernel
def quadratic_forms(points: FloatArray, whitening: FloatArray) -> FloatArray:
    """Return (N,) squared lengths of the rows of A after whitening.

    Args:
        points: (N, 4) matches.
        whitening: (9, p) matrix that the rows of A are multiplied by.
    """
    count = points.shape[0]
    forms, ones = np.zeros(count), np.ones(count)
    block, rows, dots = np.empty((5, LANES)), np.empty((9, LANES)), np.empty(LANES)
    start = FIRST
    while start < count:
        first = start
        filled, start = gather(points, ones, start, block)
        _design_columns(block, filled, rows)
        for k in range(whitening.shape[1]):
            for n in range(filled):
                dots[n] = 0.0
            for j in range(9):
                factor = whitening[j, k]
                for n in range(filled):
                    dots[n] += factor * rows[j, n]
            for n in range(filled):
                forms[first + n] += dots[n] * dots[n]
    return forms
