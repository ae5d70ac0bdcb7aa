"""Mesh files. Every writer takes vertices (V, 3), faces (T, 3), sRGB colours (V, 3) and gives the file's bytes.

trimesh is imported where it is used: it takes longer to load than everything that a calibration needs.
"""

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from sfm_app.errors import ReconstructionError
from sfm_app.geometry.triangles import vertex_normals

if TYPE_CHECKING:
    from trimesh import Trimesh

Vertices = NDArray[np.float64]
Faces = NDArray[np.int64]
Colors = NDArray[np.uint8]
Write = Callable[[Vertices, Faces, Colors], bytes]

_MATERIAL: dict[str, Any] = {
    "name": "photographed",
    "doubleSided": True,  # an open surface has no inside to hide
    "pbrMetallicRoughness": {"metallicFactor": 0.0, "roughnessFactor": 1.0},
}


def write_ply(vertices: Vertices, faces: Faces, colors: Colors) -> bytes:
    """Binary PLY with normals and sRGB colours per vertex.

    Raises:
        ReconstructionError: the mesh has no triangles.
    """
    from trimesh.exchange.ply import export_ply

    mesh = _mesh(vertices, faces)
    mesh.visual.vertex_colors = colors
    return bytes(export_ply(mesh, vertex_normal=True))


def write_glb(vertices: Vertices, faces: Faces, colors: Colors) -> bytes:
    """Binary glTF 2.0 with normals, linear colours per vertex and a rough, two-sided material.

    Without a material a viewer takes glTF's default, which is metal and looks black.

    Raises:
        ReconstructionError: the mesh has no triangles.
    """
    from trimesh import Scene
    from trimesh.exchange.gltf import export_glb

    mesh = _mesh(vertices, faces)
    # glTF multiplies COLOR_0 into the light as it is, so it has to be linear, while photos are sRGB. Floats, because
    # eight linear bits show steps in the shadows; trimesh writes only eight, so they travel as an attribute.
    mesh.vertex_attributes["_COLOR_0"] = srgb_to_linear(colors)
    return bytes(export_glb(Scene(mesh), include_normals=True, tree_postprocessor=_finish_gltf))


def srgb_to_linear(colors: Colors) -> NDArray[np.float32]:
    """Light of 8-bit sRGB values (IEC 61966-2-1), in [0, 1], same shape."""
    value = np.arange(256) / 255.0
    light = np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)
    return light.astype(np.float32)[colors]


def _mesh(vertices: Vertices, faces: Faces) -> "Trimesh":
    from trimesh import Trimesh

    if len(faces) == 0:
        raise ReconstructionError("the mesh has no triangles", hint="take more photos with more overlap")
    normals = vertex_normals(vertices, faces)
    # triangles without area leave a corner without a normal; glTF wants length 1 everywhere
    normals[np.linalg.norm(normals, axis=1) < 0.5] = (0.0, 1.0, 0.0)
    return Trimesh(vertices, faces, vertex_normals=normals, process=False)


def _finish_gltf(tree: dict[str, Any]) -> None:
    tree["asset"]["generator"] = "sfm_app"
    tree["materials"] = [_MATERIAL]
    for mesh in tree["meshes"]:
        for primitive in mesh["primitives"]:
            primitive["material"] = 0
            primitive["attributes"]["COLOR_0"] = primitive["attributes"].pop("_COLOR_0")


EXPORTERS: dict[str, tuple[Write, str]] = {
    "ply": (write_ply, "binary PLY, colours per vertex; MeshLab, CloudCompare, Blender"),
    "glb": (write_glb, "binary glTF 2.0, colours per vertex; web viewers, game engines, Blender"),
}
"""By file suffix: writer and summary."""
