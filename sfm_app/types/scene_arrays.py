"""A reconstructed scene as plain arrays."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


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
