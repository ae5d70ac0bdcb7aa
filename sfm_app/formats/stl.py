"""Binary STL, which programs for 3D printers open: bare triangles, in millimeters, z up."""

from collections.abc import Mapping

import numpy as np

from sfm_app.errors import ReconstructionError
from sfm_app.formats.checks import check
from sfm_app.types import Model

MILLIMETERS = 1000.0
"""Of a meter. STL names no unit, and printers take millimeters. By definition."""
TRIANGLE = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
HEADER_BYTES = 80


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
    check(model)
    surface = model.surface
    if not len(surface.faces):
        raise ReconstructionError("STL holds triangles only", hint="--format ply or glb for points and cameras")
    x, y, z = MILLIMETERS * surface.vertices.T
    places = np.stack([x, -z, y], axis=1)
    rows = np.zeros(len(surface.faces), TRIANGLE)
    a, b, c = np.moveaxis(places[surface.faces], 1, 0)
    normals = np.cross(b - a, c - a)
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    rows["corners"] = places[surface.faces]
    rows["normal"] = np.divide(normals, length, out=np.zeros_like(normals), where=length > 0)
    header = b"made by sfm_app".ljust(HEADER_BYTES) + np.uint32(len(rows)).tobytes()
    return {f"{name}.stl": header + rows.tobytes()}
