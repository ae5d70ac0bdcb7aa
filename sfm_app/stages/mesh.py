"""mesh: dense workspace -> Surface."""

from pathlib import Path

import numpy as np

from sfm_app.colmap.dense import poisson
from sfm_app.context import RunContext
from sfm_app.errors import ReconstructionError
from sfm_app.settings import MeshSettings
from sfm_app.types import Surface

SURFACE = "surface.npz"


def make_mesh(dense_dir: Path, options: MeshSettings, run: RunContext) -> Surface:
    """Span a surface over the fused points, cut off what they do not support, and keep it beside them.

    Raises:
        ReconstructionError: nothing is left.
        BackendError: COLMAP failed.
    """
    surface = poisson(dense_dir, options.poisson_depth, options.trim)
    run.record(vertices=len(surface.vertices), triangles=len(surface.faces))
    if not len(surface.faces):
        raise ReconstructionError("no surface is left after cleaning", hint="take more photos with more overlap")
    with run.workspace.replacing(dense_dir / SURFACE) as path:
        np.savez(path, vertices=surface.vertices, faces=surface.faces, colors=surface.colors)
    return surface


def load_surface(dense_dir: Path) -> Surface:
    """The surface that `make_mesh` left in a dense workspace."""
    with np.load(dense_dir / SURFACE) as stored:
        return Surface(stored["vertices"], stored["faces"], stored["colors"])
