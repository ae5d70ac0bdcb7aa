"""Blocks of points: boxes with about as many points each, the leaves of a k-d tree (Bentley, CACM 1975)."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]

SAMPLE = 2_000_000
"""Points by which the blocks are laid out. Chosen by hand."""


@dataclass(frozen=True, slots=True)
class Split:
    """A plane between two halves, each a block or split again."""

    axis: int
    at: float
    low: "Split | int"
    """Half with the smaller coordinates; a number is that of a block."""
    high: "Split | int"


@dataclass(frozen=True, slots=True, eq=False)
class Partition:
    """All space in blocks."""

    root: Split | int
    boxes: FloatArray
    """(B, 2, 3) lowest and highest coordinates of each block; infinite at the outside."""

    def find_blocks(self, points: FloatArray) -> NDArray[np.intp]:
        """Return (N,) the number of the block in which each point lies.

        Args:
            points: (N, 3).
        """
        found = np.empty(len(points), np.intp)
        waiting: list[tuple[Split | int, NDArray[np.intp]]] = [(self.root, np.arange(len(points)))]
        while waiting:
            node, inside = waiting.pop()
            if isinstance(node, Split):
                low = points[inside, node.axis] < node.at
                waiting += [(node.low, inside[low]), (node.high, inside[~low])]
            else:
                found[inside] = node
        return found

    def planes(self) -> list[tuple[int, float]]:
        """Return axis and coordinate of all planes between blocks, those of the first cuts first."""
        found, waiting = list[tuple[int, float]](), [self.root]
        while waiting:
            node = waiting.pop(0)
            if isinstance(node, Split):
                found.append((node.axis, node.at))
                waiting += [node.low, node.high]
        return found

    def near_planes(self, points: FloatArray, distance: float) -> NDArray[np.bool_]:
        """Return (N,) whether points lie close to a plane between blocks.

        Args:
            points: (N, 3).
            distance: up to which they are close.
        """
        near = np.zeros(len(points), np.bool_)
        for axis, at in self.planes():
            near |= np.abs(points[:, axis] - at) <= distance
        return near


def split_points(points: FloatArray, blocks: int) -> Partition:
    """Divide space into boxes with about as many points each, across their longest sides.

    Args:
        points: (N, 3).
        blocks: number of boxes, >= 1.
    """
    sample = points[:: max(1, len(points) // SAMPLE)]
    boxes: list[FloatArray] = []

    def grow(inside: FloatArray, box: FloatArray, count: int) -> Split | int:
        if count == 1 or len(inside) < 2:
            boxes.append(box)
            return len(boxes) - 1
        axis = int(np.argmax(np.percentile(inside, 99, axis=0) - np.percentile(inside, 1, axis=0)))
        left = count // 2
        at = float(np.quantile(inside[:, axis], left / count))
        below, above = box.copy(), box.copy()
        below[1, axis] = above[0, axis] = at
        low = inside[:, axis] < at
        return Split(axis, at, grow(inside[low], below, left), grow(inside[~low], above, count - left))

    whole = np.stack([np.full(3, -np.inf), np.full(3, np.inf)])
    root = grow(sample, whole, blocks)
    return Partition(root, np.stack(boxes))
