"""Wavefront OBJ, with materials (MTL) and texture pages (JPEG) in separate files."""

import re
from collections.abc import Iterator, Mapping

import numpy as np
from numpy.typing import NDArray

from sfm_app.formats.checks import check
from sfm_app.formats.frusta import append_cameras, scene_size
from sfm_app.formats.pages import NORMAL_SUFFIX, jpeg, normal_picture, pages_in_use
from sfm_app.geometry.triangles import unit_normals
from sfm_app.types import Model, Texture

DIGITS = 6
"""Significant digits of coordinates relative to the model's size, and decimals of texture coordinates."""

KEY_BASE = 10 ** (DIGITS + 1)
"""Base that combines both texture coordinates, as integers, into one key."""

CHUNK = 50_000
"""Rows formatted at once; Python numbers take several times the memory of their text."""

MATERIAL = "newmtl {name}\nKa 0 0 0\nKd 1 1 1\nKs 0 0 0\nd 1\nillum {light}\n"
"""`illum 0` shows the colors unlit: photos already contain the lighting; 1, with normal maps, lights them."""


def write_obj(model: Model, name: str) -> Mapping[str, bytes]:
    """Write triangles with normals and a texture or a color per vertex, or else points; and cameras, if any, as lines.

    Args:
        model: what to write.
        name: of the files, without suffix.

    Returns:
        The OBJ; if the model has a texture, also the MTL, a JPEG per page, and its normal map, if any.

    Raises:
        ReconstructionError: the model is empty or not finite.
    """
    check(model)
    texture = model.texture if len(model.surface.faces) else None
    beside = re.sub(r"\s", "_", name)  # many readers end file names at a blank
    text = ["# sfm_app\n", *_vertex_lines(model, with_colors=texture is None)]
    files: dict[str, bytes] = {}
    if texture is None:
        if len(model.surface.faces):
            corners = model.surface.faces + 1
            text.append(format_rows("f %d//%d %d//%d %d//%d\n", np.repeat(corners, 2, axis=1)))
    else:
        used = pages_in_use(texture.page)
        pages = {page: f"{beside}_{page}.jpg" for page in used}
        text += [f"mtllib {beside}.mtl\n", *_textured_lines(model, texture, used)]
        maps = {page: f"{beside}_{page}_normals.{NORMAL_SUFFIX}" for page in used if texture.normal_maps}
        materials = (_material(page, file, maps.get(page, "")) for page, file in pages.items())
        files[f"{beside}.mtl"] = "\n".join(materials).encode()
        files |= {file: jpeg(texture.pages[page]) for page, file in pages.items()}
        files |= {file: normal_picture(texture.normal_maps[page]) for page, file in maps.items()}
    return {f"{name}.obj": "".join(text).encode(), **files}


def _material(page: int, picture: str, normal_map: str) -> str:
    """Return the material of a page; `norm` is the name that readers have for normal maps (others are heights)."""
    text = MATERIAL.format(name=f"page_{page}", light=1 if normal_map else 0) + f"map_Kd {picture}\n"
    return text + (f"norm {normal_map}\n" if normal_map else "")


def _vertex_lines(model: Model, *, with_colors: bool) -> Iterator[str]:
    """Yield vertices, with colors after the coordinates as in MeshLab, normals, points and lines."""
    vertices, colors, lines = append_cameras(model)
    place = f"%.{decimals(model.surface.vertices)}f"
    values, form = [vertices], [place] * 3
    if with_colors:
        values, form = [vertices, colors / 255.0], [*form, *["%.4f"] * 3]
    yield format_rows(f"v {' '.join(form)}\n", np.concatenate(values, axis=1))
    if len(model.surface.faces):
        yield format_rows("vn %.4f %.4f %.4f\n", unit_normals(model.surface))
    else:
        yield format_rows("p %d\n", 1 + np.arange(len(model.surface.vertices))[:, None])
    yield format_rows("l %d %d\n", lines + 1)


def _textured_lines(model: Model, texture: Texture, pages: list[int]) -> Iterator[str]:
    """Yield texture coordinates, each once, and the triangles page by page."""
    steps = np.round(10**DIGITS * texture.uv.reshape(-1, 2).astype(np.float64)).astype(np.int64)
    steps[:, 1] = 10**DIGITS - steps[:, 1]  # 0 is at the bottom in OBJ
    keys, numbers = np.unique(steps @ np.array([KEY_BASE, 1]), return_inverse=True)
    places = np.column_stack(np.divmod(keys, KEY_BASE)) / 10**DIGITS
    yield format_rows(f"vt %.{DIGITS}f %.{DIGITS}f\n", places)
    corners = np.repeat(model.surface.faces + 1, 3, axis=1)
    corners[:, 1::3] = numbers.reshape(-1, 3) + 1
    for page in pages:
        yield f"usemtl page_{page}\n"
        yield format_rows("f %d/%d/%d %d/%d/%d %d/%d/%d\n", corners[texture.page == page])


def format_rows(form: str, values: NDArray[np.generic]) -> str:
    """Return the rows of an array (N, C) as text; formatting many at once is ten times faster than one by one.

    Args:
        form: format of one row for the % operator, with C fields.
        values: (N, C).
    """
    parts = (values[start : start + CHUNK] for start in range(0, len(values), CHUNK))
    return "".join(form * len(part) % tuple(part.ravel().tolist()) for part in parts)


def decimals(vertices: NDArray[np.float64]) -> int:
    """Return the number of decimals that gives `DIGITS` significant digits of the model's size."""
    return max(0, DIGITS - int(np.floor(np.log10(scene_size(vertices) or 1.0))))
