"""A colored triangle mesh."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, slots=True, eq=False)
class Surface:
    """Triangles with a color per vertex, in the frame of the scene."""

    vertices: NDArray[np.float64]
    """(V, 3) scene coordinates, y up."""
    faces: NDArray[np.int64]
    """(T, 3) vertex indices, counter-clockwise seen from outside."""
    colors: NDArray[np.uint8]
    """(V, 3) RGB."""
