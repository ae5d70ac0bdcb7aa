"""Poisson's surface of points, in a cube that two more points enlarge until its cells have the size asked for."""

import tempfile
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sfm_app.colmap.surface import FUSED, poisson_surface, positions, write_points
from sfm_app.geometry.triangles import select_faces
from sfm_app.meshing.octree import Cube, count_bent, count_cells
from sfm_app.types import Surface

FloatArray = NDArray[np.float64]

HALO = 24
"""Cells around a box to which the surface of its points reaches. Gaps of twenty triangles are closed in the same way
from both sides of a block, and Poisson's surface no longer depends on where the points end. Chosen by hand."""
EVERYWHERE = np.array([[-np.inf] * 3, [np.inf] * 3])
"""Bounds without end."""


@dataclass(frozen=True, slots=True)
class RecordCells:
    """The `PointCells` of the fused points, which may be too many to be held at once."""

    read: Callable[[], Iterable[NDArray[np.void]]]
    """Gives their records, part by part."""

    def points_per_cell(self, cell: float) -> float:
        """Return the mean number of points in an occupied cell.

        Args:
            cell: side of a cell.
        """
        counts = [(len(part), count_cells(positions(part), cell)) for part in self.read()]
        points, occupied = np.sum(counts, axis=0)
        return float(points / occupied)

    def bent_share(self, cell: float) -> float:
        """Return the share of cells whose normals differ.

        Args:
            cell: side of a cell.
        """
        counts = [count_bent(positions(part), _normals(part), cell) for part in self.read()]
        bent, told = np.sum(counts, axis=0)
        return float(bent / max(told, 1))


def _normals(records: NDArray[np.void]) -> FloatArray:
    """Return the normals (N, 3) of records."""
    return np.stack([records[f"n{c}"] for c in "xyz"], axis=1).astype(np.float64)


def with_halo(bounds: FloatArray, cell: float) -> FloatArray:
    """Return (..., 2, 3) bounds with their halo.

    Args:
        bounds: (..., 2, 3) lowest and highest coordinates.
        cell: side of the finest cells.
    """
    return bounds + HALO * cell * np.array([-1.0, 1.0])[:, None]


def span_surface(records: NDArray[np.void], bounds: FloatArray, cube: Cube, place: Path) -> tuple[Surface, int]:
    """Return Poisson's surface within bounds, and how many triangles all of it has.

    Args:
        records: (N,) of the points, as `open_points` has them.
        bounds: (2, 3) lowest and highest coordinates.
        cube: of the octree.
        place: folder for files that do not stay.
    """
    anchors = np.zeros(2, records.dtype)
    for axis, letter in enumerate("xyz"):
        anchors[letter] = cube.anchors[:, axis]
        anchors[f"n{letter}"] = 3.0**-0.5
    with tempfile.TemporaryDirectory(dir=place, prefix="poisson-") as scratch:
        write_points(np.concatenate([anchors, records]), Path(scratch) / FUSED)
        raw = poisson_surface(Path(scratch), cube.depth)
    inside = ((raw.vertices >= bounds[0]) & (raw.vertices <= bounds[1])).all(axis=1)
    return select_faces(raw, inside[raw.faces].all(axis=1)), len(raw.faces)
