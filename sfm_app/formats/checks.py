"""Checks that all file formats share."""

import numpy as np

from sfm_app.errors import ReconstructionError
from sfm_app.types import Model


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
