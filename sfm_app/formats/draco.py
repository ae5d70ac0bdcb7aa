"""GLB whose triangles are compressed by Draco (KHR_draco_mesh_compression); needs DracoPy.

Draco drops and reorders vertices, so counts and bounds are those of the decoded triangles. The extension is for
triangles only: points and cameras stay uncompressed.
"""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sfm_app.formats.exporters import check_writable, pages_in_use, split_corners
from sfm_app.formats.gltf import COMPONENTS, UNLIT, Glb, add_page_material, add_unlit_material, linear_colors, write_glb
from sfm_app.geometry.triangles import unit_normals
from sfm_app.types import Model, Texture
from sfm_app.types.arrays import FloatArray, IndexArray

DRACO = "KHR_draco_mesh_compression"
COLOR_ID = 7
"""Draco's number of the attribute with colors; Draco counts its own from 0. By definition."""


class OPTIONS:
    """Precision of the compressed values."""

    position_bits: int = 20
    """Bits of a coordinate along the longest side of a primitive: an error of half a millionth of it. Blender's 14 bits
    give an error of 3e-5 and files that are an eighth smaller. Chosen by hand."""
    normal_bits: int = 10
    """Bits of a normal: an error of a tenth of a degree. Chosen by hand."""
    uv_bits: int = 16
    """Bits of a texture coordinate: a quarter pixel of the largest page. Chosen by hand."""
    level: int = 7
    """Compression from 0 (fast) to 10 (small); Draco's own tools use 7. By definition."""


def write_draco(model: Model, name: str) -> Mapping[str, bytes]:
    """Write compressed triangles with a texture or a color per vertex, without cameras; points as in a plain GLB."""
    check_writable(model)
    if not len(model.surface.faces):
        return write_glb(model, name)
    glb = Glb(extensionsUsed=[UNLIT, DRACO], extensionsRequired=[DRACO], scene=0)
    textured = model.texture is not None
    primitives = _textured_primitives(glb, model, model.texture) if textured else [_colored_primitive(glb, model)]  # type: ignore[arg-type]
    mesh = glb.add("meshes", {"name": name, "primitives": primitives})
    glb.add("scenes", {"name": name, "nodes": [glb.add("nodes", {"name": name, "mesh": mesh})]})
    return {f"{name}.glb": glb.to_bytes()}


def _textured_primitives(glb: Glb, model: Model, texture: Texture) -> list[dict[str, Any]]:
    surface, normals, primitives = model.surface, unit_normals(model.surface), []
    texture = replace(texture, normal_maps=())
    for page in pages_in_use(texture.page):
        here = texture.page == page
        old, uv, faces = split_corners(surface.faces[here], texture.uv[here])
        arrays = {"normals": normals[old], "tex_coord": uv.astype(np.float64)}
        primitive = _compressed_primitive(glb, surface.vertices[old], faces, arrays)
        primitives.append(primitive | {"material": add_page_material(glb, texture, page)})
    return primitives


def _colored_primitive(glb: Glb, model: Model) -> dict[str, Any]:
    surface = model.surface
    light = np.round(65535 * linear_colors(surface.colors)).astype(np.uint16)
    arrays = {"normals": unit_normals(surface), "generic_attributes": {COLOR_ID: light}}
    primitive = _compressed_primitive(glb, surface.vertices, surface.faces, arrays)
    return primitive | {"material": add_unlit_material(glb, "colors")}


def _compressed_primitive(
    glb: Glb, vertices: FloatArray, faces: IndexArray, arrays: Mapping[str, Any]
) -> dict[str, Any]:
    """Add triangles as Draco's bytes, and return the primitive."""
    import DracoPy

    data = DracoPy.encode(
        vertices.astype(np.float32), faces.astype(np.uint32), quantization_bits=OPTIONS.position_bits,
        compression_level=OPTIONS.level, tex_coord_quantization_bits=OPTIONS.uv_bits,
        normal_quantization_bits=OPTIONS.normal_bits, **arrays,
    )  # fmt: skip
    decoded = DracoPy.decode(data)
    kinds = {
        DracoPy.AttributeType.POSITION: "POSITION",
        DracoPy.AttributeType.NORMAL: "NORMAL",
        DracoPy.AttributeType.TEX_COORD: "TEXCOORD_0",
        DracoPy.AttributeType.GENERIC: "COLOR_0",
    }
    ids, attributes = {}, {}
    for attribute in decoded.attributes:
        named = kinds[attribute["attribute_type"]]
        ids[named] = attribute["unique_id"]
        attributes[named] = glb.add("accessors", _accessor(named, np.asarray(attribute["data"])))
    corners = np.asarray(decoded.faces)
    indices = {"componentType": COMPONENTS[np.dtype(np.uint32)], "count": int(corners.size), "type": "SCALAR"}
    extension = {"bufferView": glb.add_view(data), "attributes": ids}
    return {"attributes": attributes, "indices": glb.add("accessors", indices), "extensions": {DRACO: extension}}


def _accessor(named: str, values: NDArray[np.generic]) -> dict[str, Any]:
    """Return the description of an attribute; Draco's bytes hold its values."""
    kind = COMPONENTS[np.dtype(np.uint16 if named == "COLOR_0" else np.float32)]
    entry: dict[str, Any] = {"componentType": kind, "count": len(values), "type": f"VEC{values.shape[1]}"}
    if named == "COLOR_0":
        entry["normalized"] = True
    if named == "POSITION":
        floats = values.astype(np.float32)
        entry |= {"min": floats.min(axis=0).tolist(), "max": floats.max(axis=0).tolist()}
    return entry
