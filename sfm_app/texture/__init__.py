"""Texture of a surface, from the photos that show it best."""

from sfm_app.texture.assemble import texture_surface
from sfm_app.texture.normal_map import bake_normals
from sfm_app.texture.pages import ParallelMap, Store
from sfm_app.texture.sightings import OcclusionTest
from sfm_app.texture.views import PhotoView, part_view, photo_view

__all__ = [
    "OcclusionTest",
    "ParallelMap",
    "PhotoView",
    "Store",
    "bake_normals",
    "part_view",
    "photo_view",
    "texture_surface",
]
