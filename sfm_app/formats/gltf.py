"""The container of binary glTF 2.0 (ISO/IEC 12113): a JSON tree, followed by one buffer of arrays."""

import json
import struct
from typing import Any

import numpy as np
from numpy.typing import NDArray

MAGIC, VERSION, JSON_CHUNK, BINARY_CHUNK = 0x46546C67, 2, 0x4E4F534A, 0x004E4942
VERTICES, INDICES = 34962, 34963
"""Types of buffer views, by their OpenGL constants."""
COMPONENTS = {np.dtype(np.uint16): 5123, np.dtype(np.uint32): 5125, np.dtype(np.float32): 5126}
SHAPES = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4"}
RESTART = 0xFFFF
"""The largest 16-bit number cannot be an index: OpenGL reserves it as the primitive-restart index."""


class Glb:
    """A file being built: methods add to the JSON `tree` and to the buffer, `to_bytes` returns the file."""

    def __init__(self, **tree: Any) -> None:
        self.tree: dict[str, Any] = {"asset": {"version": "2.0", "generator": "sfm_app"}, **tree}
        self._parts: list[bytes] = []
        self._length = 0

    def add(self, table: str, entry: dict[str, Any]) -> int:
        """Add an entry to a table of the tree and return its number.

        Args:
            table: "meshes", "nodes", ...
            entry: the JSON object.
        """
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

    def add_vertices(self, values: NDArray[np.float32], *, bounds: bool = False) -> int:
        """Add a vertex attribute and return the accessor's number.

        Args:
            values: (N, 2), (N, 3) or (N, 4), one row per vertex.
            bounds: whether to include the lowest and highest values, which glTF requires for positions.
        """
        entry = self._accessor(values, VERTICES)
        if bounds:
            entry |= {"min": values.min(axis=0).tolist(), "max": values.max(axis=0).tolist()}
        return self.add("accessors", entry)

    def add_indices(self, values: NDArray[np.int64], vertices: int) -> int:
        """Add vertex indices in the smallest type that fits and return the accessor's number.

        Args:
            values: vertex indices, of any shape.
            vertices: number of vertices.
        """
        small = values.ravel().astype(np.uint16 if vertices <= RESTART else np.uint32)
        return self.add("accessors", self._accessor(small, INDICES))

    def _accessor(self, values: NDArray[Any], target: int) -> dict[str, Any]:
        width = 1 if values.ndim == 1 else values.shape[1]
        data = np.ascontiguousarray(values, values.dtype.newbyteorder("<")).tobytes()
        view = self.add_view(data, target=target)
        kind = COMPONENTS[values.dtype]
        return {"bufferView": view, "componentType": kind, "count": len(values), "type": SHAPES[width]}

    def to_bytes(self) -> bytes:
        """Return the whole file."""
        tree = {**self.tree, "buffers": [{"byteLength": self._length}]}
        text = json.dumps(tree, separators=(",", ":"), ensure_ascii=False, allow_nan=False).encode()
        text += b" " * (-len(text) % 4)
        size = 12 + 8 + len(text) + 8 + self._length
        head = struct.pack("<IIIII", MAGIC, VERSION, size, len(text), JSON_CHUNK)
        return b"".join([head, text, struct.pack("<II", self._length, BINARY_CHUNK), *self._parts])
