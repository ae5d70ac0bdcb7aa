"""Matched corners of the VGG sequences that the thesis uses, and artificial outliers for them."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]


def load_corners(folder: Path, first: int, second: int) -> tuple[FloatArray, FloatArray]:
    """Read the matches of two views of a sequence.

    Args:
        folder: holds one *.corners file per view and *nview-corners: per 3D point and view the number of the corner,
            or * where the point is not seen.
        first: number of view 1, counted from 1.
        second: number of view 2.

    Returns:
        x1, x2: (N, 2) pixels.
    """
    files, (listed,) = sorted(folder.glob("*.corners")), folder.glob("*nview-corners")
    table = [line.split() for line in listed.read_text(encoding="utf-8").splitlines()]
    seen = [(row[first - 1], row[second - 1]) for row in table if "*" not in (row[first - 1], row[second - 1])]
    rows = np.array(seen, dtype=np.int64).reshape(-1, 2)
    corners = [np.loadtxt(files[view - 1]) for view in (first, second)]
    return corners[0][rows[:, 0]], corners[1][rows[:, 1]]


def with_outliers(x2: FloatArray, share: float, reach_px: float, seed: int) -> tuple[FloatArray, BoolArray]:
    """Add a uniform value in [-reach, reach] to a random share of the points; also return the mask of the others."""
    rng = np.random.default_rng([seed, 47])
    is_inlier = np.ones(len(x2), np.bool_)
    is_inlier[rng.permutation(len(x2))[: round(share * len(x2))]] = False
    moved = x2.copy()
    moved[~is_inlier] += rng.uniform(-reach_px, reach_px, (np.count_nonzero(~is_inlier), 2))
    return moved, is_inlier
