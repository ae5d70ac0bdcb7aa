"""Model files."""

from sfm_app.formats.mesh_files import EXPORTERS

__all__ = ["EXPORTERS"]
