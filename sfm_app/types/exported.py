"""A finished scene as it leaves the program: as plain arrays, and what formats are made of."""

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


@dataclass(frozen=True, slots=True, eq=False)
class SceneArrays:
    """Poses, cameras, points and tracks of a finished run, in the frame of its exported files, with y up.

    Photos are counted by N, points by P, and observations, which are the members of all tracks, by M.
    """

    photos: tuple[str, ...]
    """(N) names of the photos that have a pose."""
    cam_from_world: NDArray[np.float64]
    """(N, 3, 4) [R | t]; x right, y down, z forward in the camera."""
    K: NDArray[np.float64]
    """(N, 3, 3) camera matrix of each photo in pixels; pixel centers at +0.5."""
    sizes: NDArray[np.int64]
    """(N, 2) width and height in pixels."""
    points: NDArray[np.float64]
    """(P, 3)."""
    colors: NDArray[np.uint8]
    """(P, 3) RGB."""
    errors_px: NDArray[np.float64]
    """(P,) mean reprojection error of each point."""
    track_points: NDArray[np.int64]
    """(M,) row of the point of each observation, ascending."""
    track_photos: NDArray[np.int64]
    """(M,) row of the photo that sees it."""
    track_pixels: NDArray[np.float64]
    """(M, 2) where it sees it, as found, with the lens."""
    metric: bool
    """Whether the unit is the meter."""

    @property
    def centers(self) -> NDArray[np.float64]:
        """(N, 3) where the photos were taken from."""
        R, t = self.cam_from_world[:, :, :3], self.cam_from_world[:, :, 3]
        return np.asarray(-np.einsum("nji,nj->ni", R, t))
