"""The container of binary glTF 2.0 (ISO/IEC 12113): a tree in JSON, and one buffer of arrays behind it."""

import json
import struct
from typing import Any

import numpy as np
from numpy.typing import NDArray

MAGIC, VERSION, JSON_CHUNK, BINARY_CHUNK = 0x46546C67, 2, 0x4E4F534A, 0x004E4942
VERTICES, INDICES = 34962, 34963
"""What a view of the buffer holds, in OpenGL's numbers."""
COMPONENTS = {np.dtype(np.uint16): 5123, np.dtype(np.uint32): 5125, np.dtype(np.float32): 5126}
SHAPES = {1: "SCALAR", 2: "VEC2", 3: "VEC3"}
RESTART = 0xFFFF
"""The largest 16-bit number is no index: OpenGL starts a new strip at it."""


class Glb:
    """A file in the making: `tree` is the JSON, the methods add to it and to the buffer, `to_bytes` ends it."""

    def __init__(self, **tree: Any) -> None:
        self.tree: dict[str, Any] = {"asset": {"version": "2.0", "generator": "sfm_app"}, **tree}
        self._parts: list[bytes] = []
        self._length = 0

    def add(self, table: str, entry: dict[str, Any]) -> int:
        """Put an entry into a table of the tree; gives its number.

        Args:
            table: "meshes", "nodes", ...
            entry: as the tree has it.
        """
        entries = self.tree.setdefault(table, [])
        entries.append(entry)
        return len(entries) - 1

    def add_view(self, data: bytes, **entry: int) -> int:
        """Put bytes into the buffer, at a multiple of 4 as every type of component allows; gives the view's number."""
        view = self.add("bufferViews", {"buffer": 0, "byteOffset": self._length, "byteLength": len(data), **entry})
        padded = data + bytes(-len(data) % 4)
        self._parts.append(padded)
        self._length += len(padded)
        return view

    def add_vertices(self, values: NDArray[np.float32], *, bounds: bool = False) -> int:
        """Add an attribute of vertices; gives the accessor's number.

        Args:
            values: (N, 2) or (N, 3), one row per vertex.
            bounds: whether lowest and highest values are stated, as glTF asks for positions.
        """
        entry = self._accessor(values, VERTICES)
        if bounds:
            entry |= {"min": values.min(axis=0).tolist(), "max": values.max(axis=0).tolist()}
        return self.add("accessors", entry)

    def add_indices(self, values: NDArray[np.int64], vertices: int) -> int:
        """Add numbers of vertices, as small as fits; gives the accessor's number.

        Args:
            values: numbers of vertices, of any shape.
            vertices: how many there are.
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
