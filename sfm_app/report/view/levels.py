"""Points in levels, from a coarse sample of the whole scene to all of them."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sfm_app.types import Surface

FIRST_LEVEL = 20_000
"""Points of the first level; each later one has twice as many as the one before it. Chosen by hand: 300 kB."""
MOST_SERVED = 4_000_000
"""Points of all levels together: 60 MB."""


@dataclass(frozen=True, slots=True, eq=False)
class PointLevels:
    """Points in an order in which every beginning is spread over the scene."""

    places: NDArray[np.float32]
    """(N, 3)"""
    colors: NDArray[np.uint8]
    """(N, 3) sRGB"""
    cuts: Sequence[int]
    """Where each level begins, and the end of the last."""

    @property
    def counts(self) -> list[int]:
        """Points of each level."""
        return [end - start for start, end in zip(self.cuts[:-1], self.cuts[1:], strict=True)]

    def pack(self, level: int) -> bytes:
        """Return a level as bytes: x, y, z of all its points as little-endian floats, then their colors.

        Args:
            level: from 0.

        Raises:
            IndexError: there is no such level.
        """
        if not 0 <= level < len(self.cuts) - 1:
            raise IndexError(f"there is no level {level}")
        part = slice(self.cuts[level], self.cuts[level + 1])
        return self.places[part].astype("<f4").tobytes() + self.colors[part].tobytes()


def point_levels(points: Surface) -> PointLevels:
    """Return the points of a scene in levels, in an order drawn with a fixed seed.

    Args:
        points: with colors.
    """
    order = np.random.default_rng(0).permutation(len(points.vertices))[:MOST_SERVED]
    cuts = [0]
    while cuts[-1] < len(order):
        cuts.append(min(len(order), cuts[-1] + FIRST_LEVEL * 2 ** (len(cuts) - 1)))
    return PointLevels(points.vertices[order].astype(np.float32), points.colors[order], cuts)
