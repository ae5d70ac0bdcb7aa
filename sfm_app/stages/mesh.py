"""mesh: dense workspace -> Surface."""

from pathlib import Path

import numpy as np

from sfm_app.colmap.surface import poisson, read_fused
from sfm_app.context import RunContext
from sfm_app.errors import ReconstructionError
from sfm_app.meshing import drop_islands, octree_depth, trim_unsupported
from sfm_app.settings import MeshSettings
from sfm_app.types import Surface

SURFACE = "surface.npz"

KEPT_LEVELS = 2
"""Poisson's trimming leaves at least the surface in this many of its finest levels: few points make a coarse octree."""


def make_mesh(dense_dir: Path, options: MeshSettings, run: RunContext) -> Surface:
    """Span a surface over the fused points, cut off what they do not support, and keep it beside them.

    Raises:
        ReconstructionError: nothing is left.
        BackendError: COLMAP failed.
    """
    points, normals = read_fused(dense_dir)
    depth = octree_depth(points, options.poisson_depth)
    raw = poisson(dense_dir, depth, min(options.trim, depth - KEPT_LEVELS))
    trimmed = trim_unsupported(raw, points, normals) if options.trim else raw
    surface = drop_islands(trimmed, options.min_island)
    run.record(
        poisson_depth=depth, raw_triangles=len(raw.faces), vertices=len(surface.vertices), triangles=len(surface.faces)
    )
    if not len(surface.faces):
        raise ReconstructionError("no surface is left after cleaning", hint="take more photos with more overlap")
    with run.workspace.replacing(dense_dir / SURFACE) as path:
        np.savez(path, vertices=surface.vertices, faces=surface.faces, colors=surface.colors)
    return surface


def load_surface(dense_dir: Path) -> Surface:
    """The surface that `make_mesh` left in a dense workspace."""
    with np.load(dense_dir / SURFACE) as stored:
        return Surface(stored["vertices"], stored["faces"], stored["colors"])
