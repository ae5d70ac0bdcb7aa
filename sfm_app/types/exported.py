"""What exports of a finished scene are made of, besides the scene itself."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, slots=True, eq=False)
class PointCloud:
    """Colored points in the frame of the export."""

    points: NDArray[np.float64]
    """(P, 3)"""
    colors: NDArray[np.uint8]
    """(P, 3) RGB."""
    normals: NDArray[np.float64] | None = None
    """(P, 3) unit vectors; None where they are not known."""


@dataclass(frozen=True, slots=True, eq=False)
class PerspectivePhoto:
    """An undistorted photo, or one of several perspective views into a photo of a wide lens."""

    image: str
    """Name of its file: letters, digits, - and _, then .jpg, without folders."""
    photo: str
    """Name of the photo that it shows."""
    K: NDArray[np.float64]
    """(3, 3) in pixels; centers of pixels at +0.5."""
    width: int
    height: int
    cam_from_world: NDArray[np.float64]
    """(3, 4) [R | t] in the frame of the export; x right, y down, z forward."""
    mask: str = ""
    """Name of the file of its mask; empty where photos have none."""
