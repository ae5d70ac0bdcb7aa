"""Model files: every writer takes a `Model` and a name, and returns the bytes of its files by file name."""

from collections.abc import Callable, Mapping

from sfm_app.formats.glb import write_glb
from sfm_app.formats.obj import write_obj
from sfm_app.formats.ply import write_ply
from sfm_app.types import Model

EXPORTERS: dict[str, tuple[Callable[[Model, str], Mapping[str, bytes]], str]] = {
    "ply": (write_ply, "binary PLY, colors and normals per vertex; MeshLab, CloudCompare, Blender"),
    "glb": (write_glb, "binary glTF 2.0, textured, all in one file; web viewers, game engines, Blender"),
    "obj": (write_obj, "Wavefront OBJ with MTL and JPEG pages, textured; everything else"),
}
"""Writer and summary by format name, which is the suffix of the file to open."""

__all__ = ["EXPORTERS"]
