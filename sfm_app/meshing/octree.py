"""The resolution of Poisson reconstruction: the side of its finest cells, and its cube around the points."""

from collections.abc import Iterator
from dataclasses import dataclass
from math import log

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]

MIN_POINTS = 2.5
"""Least mean number of points in an occupied cell of Poisson's finest grid."""
MARGIN = 1.1
"""Width of Poisson's cube in extents of its points."""
ALIGNMENT = 16
"""Cells at whose multiples Poisson's cubes begin, so that the cells of blocks side by side are the same down to a few
levels. Chosen by hand."""
DEEPEST = 20
"""Levels of a grid over all points: a million cells along a side. Chosen by hand."""
COARSEST_CUBE = 5
"""Smallest depth of an octree: with less, small surfaces become too coarse."""


@dataclass(frozen=True, slots=True, eq=False)
class Cube:
    """Poisson's cube around points, on a grid that neighbors have in common."""

    depth: int
    """Of the octree."""
    anchors: FloatArray
    """(2, 3) lowest and highest corner of the points that give the octree this cube."""


def cube_around(low: FloatArray, high: FloatArray, cell: float) -> Cube:
    """Return the smallest cube on the common grid that holds points.

    Args:
        low: (3,) lowest coordinates of the points.
        high: (3,) highest coordinates of the points.
        cell: side of the finest cells.
    """
    step = ALIGNMENT * cell
    depth = COARSEST_CUBE
    while True:
        side = cell * 2.0**depth
        start = np.floor((0.5 * (low + high) - 0.5 * side) / step + 0.5) * step
        inner = np.stack([start + 0.5 * (side - side / MARGIN), start + 0.5 * (side + side / MARGIN)])
        if (inner[0] <= low).all() and (inner[1] >= high).all():
            return Cube(depth, inner)
        depth += 1


def cell_sizes(extent: float, depth: int) -> Iterator[float]:
    """Yield sides of cells, the finest first, each twice the one before.

    Args:
        extent: largest of all points.
        depth: greatest depth of an octree over them all.
    """
    for level in range(min(depth, DEEPEST), 1, -1):
        yield MARGIN * extent / 2.0**level


def occupied_cells(points: FloatArray, cell: float) -> int:
    """Return how many cells of a grid hold points (N, 3).

    Args:
        points: (N, 3).
        cell: side of a cell.
    """
    at = np.floor(points / cell).astype(np.int64)
    at -= at.min(axis=0, initial=0)
    keys = np.sort((at[:, 0] << 42) + (at[:, 1] << 21) + at[:, 2])
    return min(len(keys), 1) + int(np.count_nonzero(keys[1:] != keys[:-1]))


def choose_cell(sizes: Iterator[tuple[float, float]], least: float) -> float:
    """Return the side of the finest cells that hold enough points.

    Finer cells, most with at most one point, would only model noise, with four times the triangles per level. Between
    two sizes the points of a cell follow a power of its side.

    Args:
        sizes: side of the cells and mean number of points in an occupied one, the finest first; not empty.
        least: smallest mean number of points, > 0.
    """
    cell, finer = 0.0, 0.0
    for cell, held in sizes:
        if held >= least:
            return float(cell * 2.0 ** -(log(held / least) / log(held / finer))) if finer else cell
        finer = held
    return cell
