"""The fused points sorted by blocks: each block's are in a file of its own, so that no block reads those of all."""

import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sfm_app.colmap.surface import positions
from sfm_app.meshing.blocks.partition import Partition
from sfm_app.operating_system import move

FloatArray = NDArray[np.float64]

POINTS = "points"
"""Folder with one file of records per block."""
CHUNK = 4_000_000
"""Points that are read at once."""


@dataclass(frozen=True, slots=True, eq=False)
class BlockPoints:
    """The points of all blocks, in files."""

    folder: Path
    fields: np.dtype[np.void]
    """Of a record, as `open_points` has it."""
    bounds: FloatArray
    """(B, 2, 3) lowest and highest coordinates of the points of each block."""

    def read(self, number: int) -> NDArray[np.void]:
        """Return the records of a block.

        Args:
            number: of the block.
        """
        return np.fromfile(self.folder / str(number), self.fields)

    def read_box(self, box: FloatArray) -> NDArray[np.void]:
        """Return the records of all blocks that lie in a box.

        Args:
            box: (2, 3) lowest and highest coordinates.
        """
        meet = ((self.bounds[:, 0] <= box[1]) & (self.bounds[:, 1] >= box[0])).all(axis=1)
        parts = [np.empty(0, self.fields)]
        for number in np.flatnonzero(meet).tolist():
            records = self.read(number)
            where = positions(records)
            parts.append(records[((where >= box[0]) & (where <= box[1])).all(axis=1)])
        return np.concatenate(parts)


def sort_points(points: NDArray[np.void], partition: Partition, folder: Path) -> BlockPoints:
    """Write the points of each block into a file, unless a killed run has.

    Args:
        points: (N,) records of all points, as `open_points` has them.
        partition: the blocks.
        folder: gets a folder with the files.
    """
    place, unfinished, count = folder / POINTS, folder / f"{POINTS}-unfinished", len(partition.boxes)
    if not place.exists():
        shutil.rmtree(unfinished, ignore_errors=True)
        unfinished.mkdir()
        for number in range(count):
            (unfinished / str(number)).touch()
        for start in range(0, len(points), CHUNK):
            chunk = np.asarray(points[start : start + CHUNK])
            _add(chunk, partition.find_blocks(positions(chunk)), unfinished, count)
        move(unfinished, place)
    found = BlockPoints(place, points.dtype, np.empty((count, 2, 3)))
    for number in range(count):
        where = positions(found.read(number))
        found.bounds[number] = where.min(axis=0, initial=np.inf), where.max(axis=0, initial=-np.inf)
    return found


def _add(records: NDArray[np.void], numbers: NDArray[np.intp], folder: Path, count: int) -> None:
    """Add records to the files of their blocks, in their order."""
    ends = np.cumsum(np.bincount(numbers, minlength=count))
    parts: Sequence[NDArray[np.void]] = np.split(records[np.argsort(numbers, kind="stable")], ends[:-1])
    for number, part in enumerate(parts):
        with (folder / str(number)).open("ab") as file:
            file.write(part.tobytes())
