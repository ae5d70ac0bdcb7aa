"""Colored and textured triangle meshes."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sfm_app.types.arrays import ByteArray, Float32Array, FloatArray, IndexArray
from sfm_app.types.scene import PosedPhoto


@dataclass(frozen=True, slots=True, eq=False)
class Surface:
    """Triangles with a color per vertex, in the frame of the scene."""

    vertices: FloatArray
    """(V, 3) scene coordinates, y up."""
    faces: IndexArray
    """(T, 3) vertex indices, counter-clockwise seen from outside."""
    colors: ByteArray
    """(V, 3) RGB."""


@dataclass(frozen=True, slots=True, eq=False)
class Texture:
    """Pictures for the triangles of a surface."""

    uv: Float32Array
    """(T, 3, 2) place of each corner of each triangle on its page, in [0, 1]; (0, 0) is the page's top-left corner."""
    page: NDArray[np.int32]
    """(T,) page of each triangle."""
    pages: tuple[ByteArray, ...]
    """(H, W, 3) RGB each."""
    normal_maps: tuple[ByteArray, ...] = ()
    """One (h, w, 3) per page, of its proportions: normals in the frames of `geometry.triangles`, stored as glTF does:
    0.5 + 0.5 n, linear, +y up; empty without normal maps."""


@dataclass(frozen=True, slots=True, eq=False)
class Model:
    """A surface with or without a texture, or points (a surface without triangles) and the cameras that saw them."""

    surface: Surface
    texture: Texture | None = None
    cameras: tuple[PosedPhoto, ...] = ()
