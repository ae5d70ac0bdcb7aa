"""Binary STL, which programs for 3D printers open: bare triangles, in millimeters, z up."""

from collections.abc import Mapping

import numpy as np

from sfm_app.errors import ReconstructionError
from sfm_app.formats.checks import check
from sfm_app.types import Model

MILLIMETERS = 1000.0
"""Of a meter. STL names no unit, and printers take millimeters. By definition."""


def write_stl(model: Model, name: str) -> Mapping[str, bytes]:
    """Write the triangles of a model; STL has no colors.

    Args:
        model: what to write; its unit is taken for a meter, and its y axis, which points up, becomes z.
        name: of the file, without suffix.

    Returns:
        One file.

    Raises:
        ReconstructionError: the model is not finite, or has no triangles.
    """
    import trimesh  # slow to load, and few need it

    check(model)
    surface = model.surface
    if not len(surface.faces):
        raise ReconstructionError("STL holds triangles only", hint="--format ply or glb for points and cameras")
    x, y, z = MILLIMETERS * surface.vertices.T
    mesh = trimesh.Trimesh(np.stack([x, -z, y], axis=1), surface.faces, process=False)
    return {f"{name}.stl": bytes(mesh.export(file_type="stl"))}
