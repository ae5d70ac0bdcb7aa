"""Binary glTF 2.0: one file that web viewers, game engines and Blender open.

Photos contain the lighting; a viewer that lights their colors again makes one side darker and the other paler. So the
material is KHR_materials_unlit: three.js, Babylon.js, model-viewer, Blender and others show the original colors. Other
viewers show a rough, matte surface, lit by means of the normals. The extension is not required, so every viewer may
open the file. Without a material, viewers would use glTF's default, which is metallic and looks black.

Unlit materials ignore normal maps, so a model with normal maps is lit: rough, without metal, with tangents.
"""

import json
import re
import struct
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sfm_app.formats.exporters import NORMAL_TYPE, check_writable, jpeg, normal_picture, pages_in_use, split_corners
from sfm_app.formats.frusta import CAMERA_COLOR, camera_lines, frustum_depth
from sfm_app.geometry.triangles import corner_tangents, unit_normals
from sfm_app.types import Model, PosedPhoto, Texture
from sfm_app.types.arrays import ByteArray, Float32Array, FloatArray, IndexArray

# The container of binary glTF 2.0 (ISO/IEC 12113): a JSON tree, followed by one buffer of arrays.

MAGIC, VERSION, JSON_CHUNK, BINARY_CHUNK = 0x46546C67, 2, 0x4E4F534A, 0x004E4942
VERTICES, INDICES, LINEAR, MIPMAPS, CLAMPED = 34962, 34963, 9729, 9987, 33071
"""OpenGL's constants for buffer views, filters, wrapping and types of components. By definition."""
COMPONENTS = {np.dtype(np.uint16): 5123, np.dtype(np.uint32): 5125, np.dtype(np.float32): 5126}
SHAPES = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4"}


class Glb:
    """A file under construction: methods add to the JSON `tree` and to the buffer, `to_bytes` returns the file."""

    def __init__(self, **tree: Any) -> None:
        self.tree: dict[str, Any] = {"asset": {"version": "2.0", "generator": "sfm_app"}, **tree}
        self._parts: list[bytes] = []
        self._length = 0

    def add(self, table: str, entry: dict[str, Any]) -> int:
        """Add an entry to a table of the tree ("meshes", "nodes", ...) and return its number."""
        entries = self.tree.setdefault(table, [])
        entries.append(entry)
        return len(entries) - 1

    def add_view(self, data: bytes, **entry: int) -> int:
        """Add bytes to the buffer, aligned to 4 bytes for all component types, and return the view's number."""
        view = self.add("bufferViews", {"buffer": 0, "byteOffset": self._length, "byteLength": len(data), **entry})
        padded = data + bytes(-len(data) % 4)
        self._parts.append(padded)
        self._length += len(padded)
        return view

    def add_vertices(self, values: Float32Array, *, bounds: bool = False) -> int:
        """Add a vertex attribute (N, 2..4) and return the accessor's number; glTF requires bounds for positions."""
        entry = self._accessor(values, VERTICES)
        if bounds:
            entry |= {"min": values.min(axis=0).tolist(), "max": values.max(axis=0).tolist()}
        return self.add("accessors", entry)

    def add_indices(self, values: IndexArray, vertices: int) -> int:
        """Add indices of so many vertices in the smallest type that fits, and return the accessor's number."""
        small = values.ravel().astype(np.uint16 if vertices <= 0xFFFF else np.uint32)  # 0xFFFF restarts
        return self.add("accessors", self._accessor(small, INDICES))

    def _accessor(self, values: NDArray[Any], target: int) -> dict[str, Any]:
        width = 1 if values.ndim == 1 else values.shape[1]
        data = np.ascontiguousarray(values, values.dtype.newbyteorder("<")).tobytes()
        view = self.add_view(data, target=target)
        kind = COMPONENTS[values.dtype]
        return {"bufferView": view, "componentType": kind, "count": len(values), "type": SHAPES[width]}

    def to_text(self, **buffer: str) -> bytes:
        """Return the tree as JSON; `buffer` are further entries of its only buffer."""
        tree = {**self.tree, "buffers": [{"byteLength": self._length, **buffer}]}
        return json.dumps(tree, separators=(",", ":"), ensure_ascii=False, allow_nan=False).encode()

    @property
    def buffer(self) -> bytes:
        """The arrays."""
        return b"".join(self._parts)

    def to_bytes(self) -> bytes:
        """Return the whole file."""
        text = self.to_text()
        text += b" " * (-len(text) % 4)
        size = 12 + 8 + len(text) + 8 + self._length
        head = struct.pack("<IIIII", MAGIC, VERSION, size, len(text), JSON_CHUNK)
        return b"".join([head, text, struct.pack("<II", self._length, BINARY_CHUNK), *self._parts])


UNLIT = "KHR_materials_unlit"
FLIP = np.diag([1.0, -1.0, -1.0])
"""COLMAP's camera looks along +z with y down, glTF's camera along -z with y up."""


def opengl_pose(photo: PosedPhoto) -> FloatArray:
    """Return (4, 4) the pose of a photo, from the axes of glTF's and OpenGL's camera to the world."""
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = photo.R.T @ FLIP, photo.center
    return pose


def write_glb(model: Model, name: str) -> Mapping[str, bytes]:
    """Write triangles with a texture or a color per vertex, or else points; and the cameras, if any."""
    return {f"{name}.glb": _build(model, name).to_bytes()}


def write_gltf(model: Model, name: str) -> Mapping[str, bytes]:
    """Write the same as JSON with its arrays and pictures in a file beside it."""
    glb, arrays = _build(model, name), re.sub(r"[\s%#?]", "_", f"{name}.bin")  # an address without escapes
    return {f"{name}.gltf": glb.to_text(uri=arrays), arrays: glb.buffer}


def _build(model: Model, name: str) -> Glb:
    check_writable(model)
    texture = model.texture if len(model.surface.faces) else None
    is_lit = texture is not None and bool(texture.normal_maps)
    glb = Glb(**({} if is_lit and not model.cameras else {"extensionsUsed": [UNLIT]}), scene=0)
    if texture is not None:
        primitives = add_textured_primitives(glb, model, texture)
    else:
        primitives = [add_colored_primitive(glb, model)]
    mesh = glb.add("meshes", {"name": name, "primitives": primitives})
    nodes = [glb.add("nodes", {"name": name, "mesh": mesh})]
    if model.cameras:
        nodes += add_cameras(glb, model)
    glb.add("scenes", {"name": name, "nodes": nodes})
    return glb


def add_textured_primitives(glb: Glb, model: Model, texture: Texture) -> list[dict[str, Any]]:
    """Add an image and a material per page, and return one primitive for each."""
    surface, normals = model.surface, unit_normals(model.surface)
    at_corners, primitives = texture.uv, []
    if texture.normal_maps:
        tangents = corner_tangents(surface.vertices, normals, surface.faces, texture.uv, texture.page)
        at_corners = np.concatenate([texture.uv, tangents], axis=2)
    for page in pages_in_use(texture.page):
        here = texture.page == page
        old, values, faces = split_corners(surface.faces[here], at_corners[here])
        material = add_page_material(glb, texture, page)
        attributes = add_geometry(glb, surface.vertices[old], normals[old])
        attributes["TEXCOORD_0"] = glb.add_vertices(values[:, :2])
        if texture.normal_maps:
            attributes["TANGENT"] = glb.add_vertices(values[:, 2:])
        primitives.append({"attributes": attributes, "indices": glb.add_indices(faces, len(old)), "material": material})
    return primitives


def add_page_material(glb: Glb, texture: Texture, page: int) -> int:
    """Add a page of texture with its normal map, if any, and its material; return the material's number."""
    if not glb.tree.get("samplers"):
        glb.add("samplers", {"magFilter": LINEAR, "minFilter": MIPMAPS, "wrapS": CLAMPED, "wrapT": CLAMPED})
    name = f"page {page}"
    color = {"index": _add_picture(glb, name, "image/jpeg", jpeg(texture.pages[page]))}
    if not texture.normal_maps:
        return add_unlit_material(glb, name, baseColorTexture=color)
    relief = _add_picture(glb, f"normals {page}", NORMAL_TYPE, normal_picture(texture.normal_maps[page]))
    return glb.add("materials", _matte_material(name, baseColorTexture=color) | {"normalTexture": {"index": relief}})


def _add_picture(glb: Glb, name: str, kind: str, data: bytes) -> int:
    image = glb.add("images", {"name": name, "mimeType": kind, "bufferView": glb.add_view(data)})
    return glb.add("textures", {"sampler": 0, "source": image})


def add_colored_primitive(glb: Glb, model: Model) -> dict[str, Any]:
    """Add triangles, or points if there are none, with a color per vertex, and return the primitive."""
    surface = model.surface
    normals = unit_normals(surface) if len(surface.faces) else None
    attributes = add_geometry(glb, surface.vertices, normals) | {
        "COLOR_0": glb.add_vertices(linear_colors(surface.colors))
    }
    primitive = {"attributes": attributes, "material": add_unlit_material(glb, "colors")}
    if normals is None:
        return primitive | {"mode": 0}
    return primitive | {"indices": glb.add_indices(surface.faces, len(surface.vertices))}


def add_geometry(glb: Glb, vertices: FloatArray, normals: FloatArray | None) -> dict[str, int]:
    """Add positions (V, 3) and unit normals (V, 3) of vertices; return the accessors' numbers by attribute."""
    attributes = {"POSITION": glb.add_vertices(vertices.astype(np.float32), bounds=True)}
    return attributes if normals is None else attributes | {"NORMAL": glb.add_vertices(normals.astype(np.float32))}


def add_unlit_material(glb: Glb, name: str, **base: Any) -> int:
    """Add an unlit material and return its number; it is double-sided, because surfaces are open."""
    return glb.add("materials", _matte_material(name, **base) | {"extensions": {UNLIT: {}}})


def _matte_material(name: str, **base: Any) -> dict[str, Any]:
    rough = {**base, "metallicFactor": 0.0, "roughnessFactor": 1.0}
    return {"name": name, "doubleSided": True, "pbrMetallicRoughness": rough}


def linear_colors(colors: ByteArray) -> Float32Array:
    """Return linear light in [0, 1] of 8-bit sRGB colors, same shape (IEC 61966-2-1).

    glTF requires linear vertex colors. Values are floats: 8 linear bits show steps in the shadows, and not every reader
    supports 16 bits.
    """
    value = np.arange(256) / 255.0
    light = np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)
    return light.astype(np.float32)[colors]


def add_cameras(glb: Glb, model: Model) -> list[int]:
    """Add the cameras as lines, which every viewer draws, and as glTF cameras; return their nodes' numbers."""
    corners, lines = camera_lines(model)
    color = linear_colors(np.array(CAMERA_COLOR, np.uint8))
    material = add_unlit_material(glb, "cameras", baseColorFactor=[*(round(float(part), 6) for part in color), 1.0])
    primitive = {
        "attributes": add_geometry(glb, corners, None),
        "indices": glb.add_indices(lines, len(corners)),
        "mode": 1,
        "material": material,
    }
    mesh = glb.add("meshes", {"name": "cameras", "primitives": [primitive]})
    nodes = [glb.add("nodes", {"name": "cameras", "mesh": mesh})]
    near = 0.1 * frustum_depth(np.array([camera.center for camera in model.cameras]), model.surface.vertices)
    return nodes + [glb.add("nodes", _camera_node(glb, camera, near)) for camera in model.cameras]


def _camera_node(glb: Glb, camera: PosedPhoto, near: float) -> dict[str, Any]:
    """Add a glTF camera at the photo's pose and return its node; glTF's principal point is central."""
    lens = {
        "yfov": float(2 * np.arctan(camera.height / (2 * camera.K[1, 1]))),
        "aspectRatio": float(camera.width / camera.K[0, 0] * camera.K[1, 1] / camera.height),
        "znear": near,
    }
    number = glb.add("cameras", {"name": camera.name, "type": "perspective", "perspective": lens})
    return {"name": camera.name, "camera": number, "matrix": opengl_pose(camera).T.ravel().tolist()}
