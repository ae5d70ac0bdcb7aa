"""Binary PLY, the Stanford polygon format, which all programs for point clouds and scanned surfaces open."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sfm_app.formats.checks import check
from sfm_app.formats.frusta import camera_dots
from sfm_app.geometry.triangles import unit_normals
from sfm_app.types import Model

PLY_NAMES = {"f": "float", "u": "uchar"}
PLACE = [("x", "<f4"), ("y", "<f4"), ("z", "<f4")]
NORMAL = [("nx", "<f4"), ("ny", "<f4"), ("nz", "<f4")]
COLOR = [("red", "u1"), ("green", "u1"), ("blue", "u1")]

Columns = list[NDArray[Any]]


def write_ply(model: Model, name: str) -> Mapping[str, bytes]:
    """Write triangles with normals and a color per vertex, or points followed by the cameras as dotted frusta.

    Cameras are dots, because readers differ on files with points and edges or points and triangles, and some then show
    no points. All of them show a cloud of colored points in the same way.

    Args:
        model: what to write; PLY has no common way to store a texture, or cameras beside a surface: left out.
        name: of the file, without suffix.

    Returns:
        One file.

    Raises:
        ReconstructionError: the model is empty or not finite.
    """
    check(model)
    surface = model.surface
    if len(surface.faces):
        columns: Columns = [surface.vertices, unit_normals(surface), surface.colors]
        elements = {"vertex": table(PLACE + NORMAL + COLOR, columns), "face": triangles(surface.faces)}
    else:
        dots, colors = camera_dots(model)
        columns = [np.concatenate([surface.vertices, dots]), np.concatenate([surface.colors, colors])]
        elements = {"vertex": table(PLACE + COLOR, columns)}
    return {f"{name}.ply": header(elements).encode("ascii") + b"".join(rows.tobytes() for rows in elements.values())}


def triangles(faces: NDArray[np.int64]) -> NDArray[np.void]:
    """Return rows of three vertex indices."""
    rows = np.empty(len(faces), [("count", "u1"), ("vertex_indices", "<i4", 3)])
    rows["count"], rows["vertex_indices"] = 3, faces
    return rows


def table(kinds: list[tuple[str, str]], columns: Columns) -> NDArray[np.void]:
    """Build rows with named columns.

    Args:
        kinds: name and NumPy type of each column.
        columns: arrays (N, C), one column per name in total.
    """
    rows = np.empty(len(columns[0]), kinds)
    values = [column[:, i] for column in columns for i in range(column.shape[1])]
    for (key, _), column in zip(kinds, values, strict=True):
        rows[key] = column
    return rows


def header(elements: Mapping[str, NDArray[np.void]]) -> str:
    """Return the header, which describes the rows of each element."""
    lines = ["ply", "format binary_little_endian 1.0", "comment sfm_app"]
    for element, rows in elements.items():
        lines.append(f"element {element} {len(rows)}")
        if element == "face":
            lines.append("property list uchar int vertex_indices")
            continue
        fields = [(key, rows.dtype[key].kind) for key in rows.dtype.names or ()]
        lines += [f"property {PLY_NAMES[kind]} {key}" for key, kind in fields]
    return "\n".join([*lines, "end_header", ""])
