"""What every file format asks of a model."""

import numpy as np
from numpy.typing import NDArray

from sfm_app.errors import ReconstructionError
from sfm_app.geometry.triangles import vertex_normals
from sfm_app.types import Model, Surface


def check(model: Model) -> None:
    """Refuse what no file can hold.

    Raises:
        ReconstructionError: there is neither a triangle nor a point, or coordinates are not finite.
    """
    if not len(model.surface.vertices):
        raise ReconstructionError(
            "there is nothing to write: the model has no points", hint="take more photos with more overlap"
        )
    if not np.isfinite(model.surface.vertices).all():
        raise ReconstructionError("the model has points that lie nowhere", hint="run again from the stage `scene`")


def unit_normals(surface: Surface) -> NDArray[np.float64]:
    """Return (V, 3) normals of length 1 also where triangles without area leave a corner without one.

    GlTF asks for it.
    """
    normals = vertex_normals(surface.vertices, surface.faces)
    normals[np.linalg.norm(normals, axis=1) < 0.5] = (0.0, 1.0, 0.0)
    return normals
