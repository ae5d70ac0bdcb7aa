"""From a raw surface to a clean mesh."""

from sfm_app.meshing.clean import drop_islands, octree_depth, trim_unsupported

__all__ = ["drop_islands", "octree_depth", "trim_unsupported"]
