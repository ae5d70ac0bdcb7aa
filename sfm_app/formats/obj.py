"""Wavefront OBJ with its materials (MTL) and pages of texture (JPEG) beside it."""

import re
from collections.abc import Iterator, Mapping

import numpy as np
from numpy.typing import NDArray

from sfm_app.formats.checks import check, unit_normals
from sfm_app.formats.frusta import scene_size, with_cameras
from sfm_app.formats.pages import jpeg, pages_in_use
from sfm_app.types import Model, Texture

DIGITS = 6
"""Coordinates are exact to this many digits of the size of the model, places in the texture to as many decimals."""

ACROSS = 10 ** (DIGITS + 1)
"""Makes one number of a place in the texture."""

CHUNK = 50_000
"""Rows that are formatted at once: Python numbers take several times the memory of their text."""

MATERIAL = "newmtl {name}\nKa 0 0 0\nKd 1 1 1\nKs 0 0 0\nd 1\nillum 0\n"
"""`illum 0` shows the colors as they are: photos carry their light already."""


def write_obj(model: Model, name: str) -> Mapping[str, bytes]:
    """Return triangles with normals and their texture or a color per vertex.

    Else points; and cameras, if any, as lines.

    Args:
        model: what to write.
        name: of the files, without suffix.

    Returns:
        The OBJ; where the model has a texture, also the MTL and a JPEG per page.

    Raises:
        ReconstructionError: the model is empty or not finite.
    """
    check(model)
    texture = model.texture if len(model.surface.faces) else None
    beside = re.sub(r"\s", "_", name)  # names with blanks end at the blank for many a reader
    text = ["# sfm_app\n", *_vertex_lines(model, with_colors=texture is None)]
    files: dict[str, bytes] = {}
    if texture is None:
        if len(model.surface.faces):
            corners = model.surface.faces + 1
            text.append(rows("f %d//%d %d//%d %d//%d\n", np.repeat(corners, 2, axis=1)))
    else:
        used = pages_in_use(texture.page)
        pages = {page: f"{beside}_{page}.jpg" for page in used}
        text += [f"mtllib {beside}.mtl\n", *_textured_lines(model, texture, used)]
        materials = (MATERIAL.format(name=f"page_{page}") + f"map_Kd {file}\n" for page, file in pages.items())
        files[f"{beside}.mtl"] = "\n".join(materials).encode()
        files |= {file: jpeg(texture.pages[page]) for page, file in pages.items()}
    return {f"{name}.obj": "".join(text).encode(), **files}


def _vertex_lines(model: Model, *, with_colors: bool) -> Iterator[str]:
    """Yield vertices, with colors behind the coordinates as MeshLab began it, normals, points and lines."""
    vertices, colors, lines = with_cameras(model)
    place = f"%.{decimals(model.surface.vertices)}f"
    values, form = [vertices], [place] * 3
    if with_colors:
        values, form = [vertices, colors / 255.0], [*form, *["%.4f"] * 3]
    yield rows(f"v {' '.join(form)}\n", np.concatenate(values, axis=1))
    if len(model.surface.faces):
        yield rows("vn %.4f %.4f %.4f\n", unit_normals(model.surface))
    else:
        yield rows("p %d\n", 1 + np.arange(len(model.surface.vertices))[:, None])
    yield rows("l %d %d\n", lines + 1)


def _textured_lines(model: Model, texture: Texture, pages: list[int]) -> Iterator[str]:
    """Yield places in the texture, each once, and the triangles page by page."""
    steps = np.round(10**DIGITS * texture.uv.reshape(-1, 2).astype(np.float64)).astype(np.int64)
    steps[:, 1] = 10**DIGITS - steps[:, 1]  # 0 is at the bottom in OBJ
    keys, numbers = np.unique(steps @ np.array([ACROSS, 1]), return_inverse=True)
    places = np.column_stack(np.divmod(keys, ACROSS)) / 10**DIGITS
    yield rows(f"vt %.{DIGITS}f %.{DIGITS}f\n", places)
    corners = np.repeat(model.surface.faces + 1, 3, axis=1)
    corners[:, 1::3] = numbers.reshape(-1, 3) + 1
    for page in pages:
        yield f"usemtl page_{page}\n"
        yield rows("f %d/%d/%d %d/%d/%d %d/%d/%d\n", corners[texture.page == page])


def rows(form: str, values: NDArray[np.generic]) -> str:
    """Return every row of an array (N, C) as text; one format for many is ten times faster than one per row.

    Args:
        form: of one row, for the % operator, with C places.
        values: (N, C).
    """
    parts = (values[start : start + CHUNK] for start in range(0, len(values), CHUNK))
    return "".join(form * len(part) % tuple(part.ravel().tolist()) for part in parts)


def decimals(vertices: NDArray[np.float64]) -> int:
    """Return decimals that give `DIGITS` digits of the size of the model."""
    return max(0, DIGITS - int(np.floor(np.log10(scene_size(vertices) or 1.0))))
