"""The resolution of Poisson reconstruction: the side of its finest cells, and its cube around the points."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from math import log

import numpy as np
from numpy.typing import NDArray

from sfm_app.types.arrays import FloatArray


@dataclass(frozen=True, slots=True)
class CellOptions:
    """The choice of Poisson's cells, and the grid on which its cubes lie."""

    least_points: float = 1.5
    """Smallest mean number of points in an occupied cell: finer cells, most with one point, would only model noise,
    with four times the triangles per level. Chosen on `railing`."""
    most_points: float = 2.5
    """Mean number of points in an occupied cell of smooth surfaces: finer cells show no more after the refinement, and
    model the noise of lawns. Chosen on fountain-P11, Herz-Jesus-P8 and `garden`."""
    bent_cosine: float = 0.9
    """Length of the mean of unit normals below which a cell is bent: 26 degrees off it. Chosen by hand."""
    bent_share: float = 0.025
    """Share of bent cells from which cells become finer. `railing` has 0.03 with 1.5 points in a cell; with 2.5,
    `ornament` has 0.045, `garden` 0.02, fountain-P11 and Herz-Jesus-P8 0.015."""
    margin: float = 1.1
    """Width of Poisson's cube in extents of its points: the scale of PoissonRecon."""
    alignment: int = 16
    """Cells at whose multiples cubes begin, so that adjacent blocks have the same cells down to a few levels. Chosen
    by hand."""
    deepest: int = 20
    """Levels of a grid over all points; blocks with more levels than allowed get coarser cells. Chosen by hand."""
    coarsest_cube: int = 5
    """Smallest depth of an octree: with less, small surfaces become too coarse. Chosen by hand."""


CELLS = CellOptions()


@dataclass(frozen=True, slots=True, eq=False)
class Cube:
    """Poisson's cube around points, on a grid that neighbors have in common."""

    depth: int
    """Maximum depth of the octree."""
    anchors: FloatArray
    """(2, 3) lowest and highest corner; points there give the octree this cube."""


def cube_around(low: FloatArray, high: FloatArray, cell: float) -> Cube:
    """Return the smallest cube of cells of this side on the common grid that holds points from `low` to `high` (3,)."""
    step = CELLS.alignment * cell
    depth = CELLS.coarsest_cube
    while True:
        side = cell * 2.0**depth
        start = np.floor((0.5 * (low + high) - 0.5 * side) / step + 0.5) * step
        inner = np.stack([start + 0.5 * (side - side / CELLS.margin), start + 0.5 * (side + side / CELLS.margin)])
        if (inner[0] <= low).all() and (inner[1] >= high).all():
            return Cube(depth, inner)
        depth += 1


def cell_sizes(extent: float, depth: int) -> Iterator[float]:
    """Yield sides of cells of an octree over all points, the finest first, each twice the one before."""
    for level in range(min(depth, CELLS.deepest), 1, -1):
        yield CELLS.margin * extent / 2.0**level


def count_cells(points: FloatArray, cell: float) -> int:
    """Return how many cells of a grid hold points; points (N, 3)."""
    keys = np.sort(_number_cells(points, cell))
    return min(len(keys), 1) + int(np.count_nonzero(keys[1:] != keys[:-1]))


def count_bent(points: FloatArray, normals: FloatArray, cell: float) -> tuple[int, int]:
    """Return in how many cells the unit normals (N, 3) differ, and how many have two points or more."""
    _, own, count = np.unique(_number_cells(points, cell), return_inverse=True, return_counts=True)
    total = np.stack([np.bincount(own, component, len(count)) for component in normals.T], axis=1)
    bent = np.linalg.norm(total, axis=1) < CELLS.bent_cosine * count
    return int(np.count_nonzero(bent & (count > 1))), int(np.count_nonzero(count > 1))


def _number_cells(points: FloatArray, cell: float) -> NDArray[np.int64]:
    at = np.floor(points / cell).astype(np.int64)
    at -= at.min(axis=0, initial=0)
    return np.asarray((at[:, 0] << 42) + (at[:, 1] << 21) + at[:, 2])


def choose_cell(
    sizes: Sequence[float], points_per_cell: Callable[[float], float], bent_share: Callable[[float], float],
    least: float = CELLS.least_points,
) -> float:  # fmt: skip
    """Return the side of Poisson's finest cells by the density of the points; smaller where surfaces are bent.

    Thin things and ornaments are lost in cells of several points, walls are not. The sizes are the finest first, each
    twice the one before. Of the cells of a side, `points_per_cell` returns the mean number of points in an occupied
    one, at least `least`, and `bent_share` the share with normals that differ.
    """
    density = cache(points_per_cell)
    fine, coarse = (find_size(sizes, density, points) for points in (least, max(least, CELLS.most_points)))
    if fine == coarse:
        return fine
    if (bent_if_coarse := bent_share(2.0 * coarse)) <= CELLS.bent_share:
        return coarse
    if (bent_if_fine := bent_share(2.0 * fine)) >= CELLS.bent_share:
        return fine
    share = log(CELLS.bent_share / max(bent_if_fine, 1e-6)) / log(bent_if_coarse / max(bent_if_fine, 1e-6))
    return float(fine * (coarse / fine) ** share)


def find_size(sizes: Sequence[float], points_per_cell: Callable[[float], float], points: float) -> float:
    """Return the smallest of the sizes, finest first, with enough points per cell; a power of the side in between."""
    cell, finer = 0.0, 0.0
    for cell in sizes:
        if (density := points_per_cell(cell)) >= points:
            return float(cell * 2.0 ** -(log(density / points) / log(density / finer))) if finer else cell
        finer = density
    return cell
