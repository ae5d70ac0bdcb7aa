"""Checks and normals that all file formats share."""

import numpy as np
from numpy.typing import NDArray

from sfm_app.errors import ReconstructionError
from sfm_app.geometry.triangles import vertex_normals
from sfm_app.types import Model, Surface


def check(model: Model) -> None:
    """Check that a model can be written.

    Raises:
        ReconstructionError: there is neither a triangle nor a point, or coordinates are not finite.
    """
    if not len(model.surface.vertices):
        raise ReconstructionError(
            "there is nothing to write: the model has no points", hint="take more photos with more overlap"
        )
    if not np.isfinite(model.surface.vertices).all():
        raise ReconstructionError("coordinates of the model are not finite", hint="run again from the stage `scene`")


def unit_normals(surface: Surface) -> NDArray[np.float64]:
    """Return (V, 3) unit normals; (0, 1, 0) where triangles without area do not define one.

    glTF requires unit normals.
    """
    normals = vertex_normals(surface.vertices, surface.faces)
    normals[np.linalg.norm(normals, axis=1) < 0.5] = (0.0, 1.0, 0.0)
    return normals
