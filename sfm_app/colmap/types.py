"""Names for COLMAP's types, for code that passes them on, and the types that pycolmap's stubs leave out."""

from collections.abc import Iterable
from typing import Protocol

from sfm_app.colmap.backend import pycolmap

Reconstruction = pycolmap.Reconstruction
Camera = pycolmap.Camera
CancellationToken = pycolmap.CancellationToken


class Cancellation(Protocol):
    """Token that tells a mapper to stop: COLMAP's, or one of ours."""

    @property
    def is_cancelled(self) -> bool:
        """Whether to stop."""


# The stubs of pycolmap 4.2 do not type the elements of COLMAP's maps.


def all_cameras(model: pycolmap.Reconstruction) -> Iterable[pycolmap.Camera]:
    """Return all cameras of a model."""
    found: Iterable[pycolmap.Camera] = model.cameras.values()
    return found


def all_images(model: pycolmap.Reconstruction) -> Iterable[pycolmap.Image]:
    """Return all photos of a model, with and without a pose."""
    found: Iterable[pycolmap.Image] = model.images.values()
    return found


def all_points(model: pycolmap.Reconstruction) -> Iterable[tuple[int, pycolmap.Point3D]]:
    """Return all points of a model with their ids."""
    found: Iterable[tuple[int, pycolmap.Point3D]] = model.points3D.items()
    return found
