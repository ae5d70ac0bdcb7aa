"""The surface moved to where the photos agree best, before it is simplified."""

from collections.abc import Sequence
from pathlib import Path

from sfm_app.colmap.dense import read_depth, read_gray
from sfm_app.meshing.refinement import Refinement, RefinePhoto, Spread, refine
from sfm_app.settings import MeshSettings
from sfm_app.stereo import View, rank_neighbors
from sfm_app.types import Surface

PARTNERS = 3
"""Photos that each one is compared with. Chosen by hand."""
FINER = 20
"""Most triangles while the surface is refined, as a multiple of those that it may have in the end. Chosen by hand."""


def refine_surface(
    surface: Surface, dense_dir: Path, views: Sequence[View], options: MeshSettings, spread: Spread = map
) -> Refinement:
    """Return a surface with the detail of the undistorted photos.

    Args:
        surface: what the depth maps give.
        dense_dir: folder with the undistorted photos and their maps, which are negative where masked.
        views: the photos that may see it.
        options: how many triangles the mesh may have in the end.
        spread: applies a function to the numbers of photos, possibly in parallel.
    """
    photos = [
        RefinePhoto(view.K, view.R, view.t, read_gray(dense_dir, view), read_depth(dense_dir, view, "geometric") < 0)
        for view in views
    ]
    return refine(surface, photos, rank_neighbors(views, PARTNERS), FINER * options.faces, spread)
