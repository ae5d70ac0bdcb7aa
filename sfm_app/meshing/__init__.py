"""From a raw surface to a clean mesh and its files."""

from sfm_app.meshing.export import EXPORTERS

__all__ = ["EXPORTERS"]
