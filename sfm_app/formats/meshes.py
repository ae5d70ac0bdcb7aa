"""Meshes as PLY, OBJ and STL, and clouds as PLY and LAZ."""

import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sfm_app.errors import ReconstructionError
from sfm_app.formats.exporters import FinishedScene, check_writable, normal_file, page_files, page_pictures
from sfm_app.formats.frusta import append_cameras, camera_dots, scene_size
from sfm_app.geometry.triangles import unit_normals
from sfm_app.types import Model, Texture
from sfm_app.types.arrays import FloatArray, IndexArray
from sfm_app.types.scene import PointCloud

# Binary PLY, the Stanford polygon format, which all programs for point clouds and scanned surfaces open.

PLY_NAMES = {"f": "float", "u": "uchar"}
PLACE = [("x", "<f4"), ("y", "<f4"), ("z", "<f4")]
NORMAL = [("nx", "<f4"), ("ny", "<f4"), ("nz", "<f4")]
COLOR = [("red", "u1"), ("green", "u1"), ("blue", "u1")]

Columns = list[NDArray[Any]]


def write_ply(model: Model, name: str) -> Mapping[str, bytes]:
    """Write triangles with normals and a color per vertex, or points followed by the cameras as dotted frusta.

    Cameras are dots: readers differ on files with points and edges, but all show colored points in the same way. PLY
    has no common way to store a texture, or cameras beside a surface: both are left out.
    """
    check_writable(model)
    surface = model.surface
    if len(surface.faces):
        columns: Columns = [surface.vertices, unit_normals(surface), surface.colors]
        elements = {"vertex": table(PLACE + NORMAL + COLOR, columns), "face": triangles(surface.faces)}
    else:
        dots, colors = camera_dots(model)
        columns = [np.concatenate([surface.vertices, dots]), np.concatenate([surface.colors, colors])]
        elements = {"vertex": table(PLACE + COLOR, columns)}
    return {f"{name}.ply": header(elements).encode("ascii") + b"".join(rows.tobytes() for rows in elements.values())}


def triangles(faces: IndexArray) -> NDArray[np.void]:
    """Return rows of three vertex indices."""
    rows = np.empty(len(faces), [("count", "u1"), ("vertex_indices", "<i4", 3)])
    rows["count"], rows["vertex_indices"] = 3, faces
    return rows


def table(kinds: list[tuple[str, str]], columns: Columns) -> NDArray[np.void]:
    """Build rows with columns of these names and NumPy types from arrays (N, C) with as many columns in total."""
    rows = np.empty(len(columns[0]), kinds)
    values = [column[:, i] for column in columns for i in range(column.shape[1])]
    for (key, _), column in zip(kinds, values, strict=True):
        rows[key] = column
    return rows


def header(elements: Mapping[str, NDArray[np.void]]) -> str:
    """Return PLY's header, which describes the rows of each element."""
    lines = ["ply", "format binary_little_endian 1.0", "comment sfm_app"]
    for element, rows in elements.items():
        lines.append(f"element {element} {len(rows)}")
        if element == "face":
            lines.append("property list uchar int vertex_indices")
            continue
        fields = [(key, rows.dtype[key].kind) for key in rows.dtype.names or ()]
        lines += [f"property {PLY_NAMES[kind]} {key}" for key, kind in fields]
    return "\n".join([*lines, "end_header", ""])


def write_cloud_ply(scene: FinishedScene, target: Path) -> None:
    """Write the dense cloud as binary PLY with normals and colors."""
    target.write_bytes(cloud_ply(scene.cloud()))


def cloud_ply(cloud: PointCloud) -> bytes:
    """Return points as binary PLY, with their normals, if any."""
    columns: Columns = [cloud.points, cloud.colors]
    kinds = PLACE + COLOR
    if cloud.normals is not None:
        columns, kinds = [cloud.points, cloud.normals, cloud.colors], PLACE + NORMAL + COLOR
    rows = table(kinds, columns)
    return header({"vertex": rows}).encode("ascii") + rows.tobytes()


def write_las(scene: FinishedScene, target: Path, *, compressed: bool = False) -> None:
    """Write the dense cloud as LAS or LAZ with colors, exact to a hundred-millionth of its size; needs laspy."""
    import laspy

    cloud, wkt = scene.cloud_on_map()
    head = laspy.LasHeader(point_format=2, version="1.2")  # the first version with colors: every reader knows it
    if wkt:
        head = laspy.LasHeader(point_format=7, version="1.4")  # the first version with systems of any kind
        head.vlrs.append(laspy.vlrs.known.WktCoordinateSystemVlr(wkt))
        head.global_encoding.wkt = True
    head.creation_date = None  # same cloud, same bytes
    head.generating_software = "sfm_app"
    extent = float(np.ptp(cloud.points, axis=0).max()) or 1.0
    step = float(10.0 ** np.ceil(np.log10(extent / 2e9)))  # 32 bits hold the longest side
    head.offsets, head.scales = cloud.points.min(axis=0), np.full(3, step)
    las = laspy.LasData(head)
    las.x, las.y, las.z = cloud.points.T
    las.red, las.green, las.blue = cloud.colors.T.astype(np.uint16) * 257  # LAS has 16-bit colors
    with target.open("wb") as file:
        las.write(file, do_compress=compressed, laz_backend=laspy.LazBackend.Lazrs)


# Wavefront OBJ, with materials (MTL) and texture pages (JPEG) in separate files.

DIGITS = 6
"""Significant digits of coordinates relative to the model's size, and decimals of texture coordinates. By hand."""
MATERIAL = "newmtl {name}\nKa 0 0 0\nKd 1 1 1\nKs 0 0 0\nd 1\nillum {light}\n"
"""`illum 0` shows the colors unlit: photos already contain the lighting; 1, with normal maps, lights them."""


def write_obj(model: Model, name: str) -> Mapping[str, bytes]:
    """Write triangles with texture or colors, else points, and cameras as lines: OBJ, MTL, a JPEG per page."""
    check_writable(model)
    pages = page_files(model, name)
    text = ["# sfm_app\n", *_vertex_lines(model, with_colors=not pages)]
    files: dict[str, bytes] = {}
    if model.texture is not None and pages:
        library = re.sub(r"\s", "_", f"{name}.mtl")
        text += [f"mtllib {library}\n", *_textured_lines(model, model.texture, list(pages))]
        maps = {page: normal_file(file) for page, file in pages.items() if model.texture.normal_maps}
        materials = (_material(page, file, maps.get(page, "")) for page, file in pages.items())
        files = {library: "\n".join(materials).encode(), **page_pictures(model.texture, pages)}
    elif len(model.surface.faces):
        corners = model.surface.faces + 1
        text.append(format_rows("f %d//%d %d//%d %d//%d\n", np.repeat(corners, 2, axis=1)))
    return {f"{name}.obj": "".join(text).encode(), **files}


def _material(page: int, picture: str, normal_map: str) -> str:
    """Return the material of a page; readers call normal maps `norm`, and heights `bump`."""
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
    base = 10 ** (DIGITS + 1)  # both coordinates, as integers, make one key
    keys, numbers = np.unique(steps @ np.array([base, 1]), return_inverse=True)
    places = np.column_stack(np.divmod(keys, base)) / 10**DIGITS
    yield format_rows(f"vt %.{DIGITS}f %.{DIGITS}f\n", places)
    corners = np.repeat(model.surface.faces + 1, 3, axis=1)
    corners[:, 1::3] = numbers.reshape(-1, 3) + 1
    for page in pages:
        yield f"usemtl page_{page}\n"
        yield format_rows("f %d/%d/%d %d/%d/%d %d/%d/%d\n", corners[texture.page == page])


def format_rows(form: str, values: NDArray[np.generic]) -> str:
    """Return the rows of an array (N, C) as text, by a % format with C fields; one call for many rows is fast."""
    chunk = 50_000  # Python numbers take several times the memory of their text
    parts = (values[start : start + chunk] for start in range(0, len(values), chunk))
    return "".join(form * len(part) % tuple(part.ravel().tolist()) for part in parts)


def decimals(vertices: FloatArray) -> int:
    """Return the number of decimals that gives `DIGITS` significant digits of the model's size."""
    return max(0, DIGITS - int(np.floor(np.log10(scene_size(vertices) or 1.0))))


# Binary STL, which programs for 3D printers open: bare triangles, in millimeters, z up.


def write_stl(model: Model, name: str) -> Mapping[str, bytes]:
    """Write the triangles of a model without colors; its unit is taken for a meter, and y, which is up, becomes z."""
    import trimesh  # slow to load, and few need it

    check_writable(model)
    surface = model.surface
    if not len(surface.faces):
        raise ReconstructionError("STL holds triangles only", hint="--format ply or glb for points and cameras")
    x, y, z = 1000.0 * surface.vertices.T  # STL names no unit, and printers take millimeters
    mesh = trimesh.Trimesh(np.stack([x, -z, y], axis=1), surface.faces, process=False)
    return {f"{name}.stl": bytes(mesh.export(file_type="stl"))}
