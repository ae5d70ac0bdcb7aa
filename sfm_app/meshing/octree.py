"""The resolution of Poisson reconstruction: the side of its finest cells, and its cube around the points."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from math import log
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from sfm_app.types.arrays import FloatArray

LEAST_POINTS = 1.5
"""Smallest mean number of points in an occupied cell: finer cells, most with one point, would only model noise, with
four times the triangles per level. Chosen on `railing`."""
MOST_POINTS = 2.5
"""Mean number of points in an occupied cell where surfaces are smooth: finer cells than that show no more, once the
photos refine them, and model the noise of lawns. Chosen on fountain-P11, Herz-Jesus-P8 and `garden`."""
BENT_COSINE = 0.9
"""Length of the mean of unit normals below which a cell is bent: they are 26 degrees off it. Chosen by hand."""
BENT_SHARE = 0.025
"""Share of bent cells from which on cells are finer. `railing` has 0.03 with one and a half points in a cell; with two
and a half, `ornament` 0.045, `garden` 0.02, fountain-P11 and Herz-Jesus-P8 0.015."""
MARGIN = 1.1
"""Width of Poisson's cube in extents of its points."""
ALIGNMENT = 16
"""Cells at whose multiples Poisson's cubes begin, so that the cells of blocks side by side are the same down to a few
levels. Chosen by hand."""
DEEPEST = 20
"""Levels of a grid over all points; blocks with more levels than allowed get coarser cells. Chosen by hand."""
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
    """Yield sides of cells, the finest first, each twice the one before."""
    for level in range(min(depth, DEEPEST), 1, -1):
        yield MARGIN * extent / 2.0**level


class PointCells(Protocol):
    """What is asked about the cells of a grid over oriented points."""

    def points_per_cell(self, cell: float) -> float:
        """Return the mean number of points in an occupied cell of that side."""

    def bent_share(self, cell: float) -> float:
        """Return the share of cells of that side whose normals differ."""


def count_cells(points: FloatArray, cell: float) -> int:
    """Return how many cells of a grid hold points.

    Args:
        points: (N, 3).
    """
    keys = np.sort(_number_cells(points, cell))
    return min(len(keys), 1) + int(np.count_nonzero(keys[1:] != keys[:-1]))


def count_bent(points: FloatArray, normals: FloatArray, cell: float) -> tuple[int, int]:
    """Return in how many cells the normals differ, and how many have two points or more.

    Args:
        points: (N, 3).
        normals: (N, 3) unit vectors.
    """
    _, own, count = np.unique(_number_cells(points, cell), return_inverse=True, return_counts=True)
    total = np.stack([np.bincount(own, along, len(count)) for along in normals.T], axis=1)
    bent = np.linalg.norm(total, axis=1) < BENT_COSINE * count
    return int(np.count_nonzero(bent & (count > 1))), int(np.count_nonzero(count > 1))


def _number_cells(points: FloatArray, cell: float) -> NDArray[np.int64]:
    """Return (N,) a number for the cell of each point."""
    at = np.floor(points / cell).astype(np.int64)
    at -= at.min(axis=0, initial=0)
    return np.asarray((at[:, 0] << 42) + (at[:, 1] << 21) + at[:, 2])


def choose_cell(sizes: Sequence[float], cells: PointCells, least: float = LEAST_POINTS) -> float:
    """Return the side of Poisson's finest cells: as large as the points are many, smaller where surfaces are bent.

    Thin things and ornaments are lost in cells of several points, walls are not.

    Args:
        sizes: allowed sides, the finest first, each twice the one before; not empty.
        least: smallest mean number of points in an occupied cell, > 0.
    """
    held = cache(cells.points_per_cell)
    fine, coarse = (find_size(sizes, held, points) for points in (least, max(least, MOST_POINTS)))
    if fine == coarse:
        return fine
    if (bent_if_coarse := cells.bent_share(2.0 * coarse)) <= BENT_SHARE:
        return coarse
    if (bent_if_fine := cells.bent_share(2.0 * fine)) >= BENT_SHARE:
        return fine
    way = log(BENT_SHARE / max(bent_if_fine, 1e-6)) / log(bent_if_coarse / max(bent_if_fine, 1e-6))
    return float(fine * (coarse / fine) ** way)


def find_size(sizes: Sequence[float], points_per_cell: Callable[[float], float], wanted: float) -> float:
    """Return the smallest side of cells that hold as many points; between two sizes, these follow a power of the side.

    Args:
        sizes: allowed sides, the finest first, each twice the one before.
        wanted: that number, > 0.
    """
    cell, finer = 0.0, 0.0
    for cell in sizes:
        if (held := points_per_cell(cell)) >= wanted:
            return float(cell * 2.0 ** -(log(held / wanted) / log(held / finer))) if finer else cell
        finer = held
    return cell
