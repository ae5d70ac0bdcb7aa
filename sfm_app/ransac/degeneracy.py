"""Matches that do not determine F: all on one plane, or taken without moving the camera."""

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]


def find_degeneracy(points: FloatArray, f: FloatArray, threshold: float) -> str:
    """ "planar", "rotation", or "" when the matches determine F."""
    return ""
