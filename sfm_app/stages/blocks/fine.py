"""The surface as it was before simplification, kept for the normal map."""

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sfm_app.atomic_io import replace_atomically
from sfm_app.geometry.triangles import number_vertices
from sfm_app.hashing import load_arrays
from sfm_app.types import Surface


@dataclass(frozen=True, slots=True, eq=False)
class FineShape:
    """Triangles without colors, as small as they are kept."""

    vertices: NDArray[np.float32]
    """(V, 3) in the frame of the scene."""
    faces: NDArray[np.int32]
    """(T, 3) vertex indices, counter-clockwise seen from outside."""

    @classmethod
    def from_surface(cls, surface: Surface) -> "FineShape":
        """Return the shape of a surface."""
        return cls(surface.vertices.astype(np.float32), surface.faces.astype(np.int32))

    @classmethod
    def load(cls, path: Path) -> "FineShape":
        """Read what `save_fine` wrote."""
        stored = load_arrays(path)
        return cls(stored["vertices"], stored["faces"])

    def select(self, keep: NDArray[np.bool_]) -> "FineShape":
        """Return the marked triangles (T,) with the vertices that they use."""
        used, faces = number_vertices(self.faces[keep])
        return FineShape(self.vertices[used], faces.astype(np.int32))


def save_fine(parts: Iterable[FineShape], path: Path) -> None:
    """Write parts of a surface as one, atomically.

    Args:
        parts: one after the other.
        path: where they go.
    """
    vertices, faces, count = [np.empty((0, 3), np.float32)], [np.empty((0, 3), np.int32)], 0
    for part in parts:
        vertices.append(part.vertices)
        faces.append(part.faces + np.int32(count))
        count += len(part.vertices)
    with replace_atomically(path) as beside:
        np.savez(beside, vertices=np.concatenate(vertices), faces=np.concatenate(faces))
