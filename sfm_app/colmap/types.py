"""COLMAP's objects by name, for code that passes them on, and the types that pycolmap's stubs leave out."""

from collections.abc import Iterable
from typing import Protocol

from sfm_app.colmap.backend import pycolmap

Reconstruction = pycolmap.Reconstruction
CancellationToken = pycolmap.CancellationToken


class Cancellation(Protocol):
    """Tells a mapper to stop: COLMAP's token, or one of ours."""

    @property
    def is_cancelled(self) -> bool:
        """Whether to stop."""


# In the stubs of pycolmap 4.2 the views of COLMAP's maps have no types of what they hold.


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
