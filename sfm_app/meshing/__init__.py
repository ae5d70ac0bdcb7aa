"""From a raw surface to a clean mesh and its files."""

from sfm_app.meshing.clean import drop_islands, octree_depth, trim_unsupported
from sfm_app.meshing.export import EXPORTERS

__all__ = ["EXPORTERS", "drop_islands", "octree_depth", "trim_unsupported"]
