"""A lit GLB read back, and the normals that a viewer shades it with."""

import io
import json
import struct
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image

FloatArray = NDArray[np.float64]

KINDS: dict[int, np.dtype[Any]] = {5123: np.dtype("<u2"), 5125: np.dtype("<u4"), 5126: np.dtype("<f4")}
WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}
TRIANGLES = 4
"""glTF's mode of a primitive that has none."""


@dataclass(frozen=True, slots=True, eq=False)
class LitPart:
    """The triangles of one material."""

    vertices: FloatArray
    """(V, 3)"""
    normals: FloatArray
    """(V, 3)"""
    tangents: FloatArray
    """(V, 4)"""
    uv: FloatArray
    """(V, 2)"""
    faces: NDArray[np.int64]
    """(T, 3)"""
    relief: NDArray[np.uint8]
    """(H, W, 3) the normal map."""

    def shading_normals(
        self, face: NDArray[np.int64], shares: FloatArray, *, mapped: bool, mikk: bool = False
    ) -> FloatArray:
        """Return the unit normals (N, 3) by which places on triangles are shaded.

        Args:
            face: (N,) triangles.
            shares: (N, 3) barycentric coordinates.
            mapped: whether the normal map counts.
            mikk: whether frames are those of MikkTSpace instead of three.js.
        """
        corners = self.faces[face]

        def mix(values: FloatArray) -> FloatArray:
            return np.asarray((shares[:, :, None] * values[corners]).sum(axis=1))

        up = mix(self.normals)
        if not mapped:
            return _unit(up)
        bitangents = self.tangents[:, 3:] * np.cross(self.normals, self.tangents[:, :3])
        along, across = mix(self.tangents[:, :3]), mix(bitangents)
        if mikk:
            across = self.tangents[corners[:, 0], 3:] * np.cross(up, along)
        else:
            along, across, up = _unit(along), _unit(across), _unit(up)
        found = sample_normals(self.relief, mix(self.uv))
        return _unit(found[:, :1] * along + found[:, 1:2] * across + found[:, 2:] * up)


def read_lit(data: bytes) -> list[LitPart]:
    """Read the textured primitives with normal maps of a GLB.

    Args:
        data: the file.

    Raises:
        KeyError: a primitive has no normal map, or no tangents.
    """
    size = struct.unpack_from("<I", data, 12)[0]
    tree, buffer = json.loads(data[20 : 20 + size]), data[28 + size :]
    found = []
    for primitive in (one for mesh in tree["meshes"] for one in mesh["primitives"]):
        if primitive.get("mode", TRIANGLES) != TRIANGLES:
            continue
        names = ("POSITION", "NORMAL", "TANGENT", "TEXCOORD_0")
        arrays = [_array(tree, buffer, primitive["attributes"][name]).astype(np.float64) for name in names]
        faces = _array(tree, buffer, primitive["indices"]).astype(np.int64).reshape(-1, 3)
        texture = tree["textures"][tree["materials"][primitive["material"]]["normalTexture"]["index"]]
        view = tree["bufferViews"][tree["images"][texture["source"]]["bufferView"]]
        start = view["byteOffset"]
        picture = Image.open(io.BytesIO(buffer[start : start + view["byteLength"]])).convert("RGB")
        vertices, normals, tangents, uv = arrays
        found.append(LitPart(vertices, normals, tangents, uv, faces, np.asarray(picture)))
    return found


def sample_normals(relief: NDArray[np.uint8], uv: FloatArray) -> FloatArray:
    """Return (N, 3) what bilinear sampling of a normal map gives, from -1 to 1; its length is not 1.

    Args:
        relief: (H, W, 3) the normal map.
        uv: (N, 2) places, from its top left.
    """
    at = (uv * relief.shape[1::-1] - 0.5).astype(np.float32)
    rows = np.array_split(at, -(-len(at) // 30_000))  # OpenCV's limit is 32 767
    values = [
        cv2.remap(
            relief.astype(np.float32), part[:, :1], part[:, 1:], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
        )
        for part in rows
    ]
    return np.asarray(2.0 * np.concatenate(values)[:, 0] / 255.0 - 1.0, np.float64)


def angles_deg(a: FloatArray, b: FloatArray) -> FloatArray:
    """Return (N,) the angles between unit vectors (N, 3)."""
    return np.asarray(np.degrees(2.0 * np.arcsin(np.clip(0.5 * np.linalg.norm(a - b, axis=1), 0.0, 1.0))))


def _array(tree: dict[str, Any], buffer: bytes, number: int) -> NDArray[Any]:
    entry = tree["accessors"][number]
    view, kind, width = tree["bufferViews"][entry["bufferView"]], KINDS[entry["componentType"]], WIDTHS[entry["type"]]
    values: NDArray[Any] = np.frombuffer(buffer, kind, entry["count"] * width, view["byteOffset"])
    return values.reshape(-1, width) if width > 1 else values


def _unit(vectors: FloatArray) -> FloatArray:
    return np.asarray(vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-12))
