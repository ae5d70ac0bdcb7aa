"""Poisson's surface of points, in a cube that two more points enlarge until its cells have the size asked for."""

import tempfile
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sfm_app.colmap.surface import FUSED, poisson_surface, write_points
from sfm_app.geometry.triangles import select_faces
from sfm_app.meshing.octree import Cube
from sfm_app.types import Surface

FloatArray = NDArray[np.float64]

HALO = 24
"""Cells around a box to which the surface of its points reaches. Gaps of twenty triangles are closed in the same way
from both sides of a block, and Poisson's surface no longer depends on where the points end. Chosen by hand."""


def with_halo(bounds: FloatArray, cell: float) -> FloatArray:
    """Return (..., 2, 3) bounds with their halo.

    Args:
        bounds: (..., 2, 3) lowest and highest coordinates.
        cell: side of the finest cells.
    """
    return bounds + HALO * cell * np.array([-1.0, 1.0])[:, None]


def span_surface(
    records: NDArray[np.void], bounds: FloatArray, cube: Cube, place: Path, name: str = "poisson"
) -> tuple[Surface, int]:
    """Return Poisson's surface within bounds, and how many triangles all of it has.

    Args:
        records: (N,) of the points, as `open_points` has them.
        bounds: (2, 3) lowest and highest coordinates.
        cube: of the octree.
        place: folder for files that do not stay.
        name: of the folder in it; another worker may be at the same points.
    """
    anchors = np.zeros(2, records.dtype)
    for axis, letter in enumerate("xyz"):
        anchors[letter] = cube.anchors[:, axis]
        anchors[f"n{letter}"] = 3.0**-0.5
    with tempfile.TemporaryDirectory(dir=place, prefix=f"{name}-") as scratch:
        write_points(np.concatenate([anchors, records]), Path(scratch) / FUSED)
        raw = poisson_surface(Path(scratch), cube.depth)
    inside = ((raw.vertices >= bounds[0]) & (raw.vertices <= bounds[1])).all(axis=1)
    return select_faces(raw, inside[raw.faces].all(axis=1)), len(raw.faces)
