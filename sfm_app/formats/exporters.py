"""Exporters: what each file format offers, and the parts that formats share."""

import io
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from sfm_app.errors import ReconstructionError
from sfm_app.types import Model, Scene, Texture
from sfm_app.types.arrays import ByteArray, Float32Array, IndexArray
from sfm_app.types.scene import PerspectivePhoto, PointCloud

INSTALL_HINT = "pip install 'sfm-app[export]'"
SCENE, CLOUD = "scene", "cloud"
"""Input of a scene format: cameras, poses and sparse points; or the dense cloud, too."""


WriteModel = Callable[[Model, str], Mapping[str, bytes]]
"""Makes model files by name: first the one to open (the name given, with the format's suffix), then those it refers to.

Takes a surface with a texture (pages of pictures, perhaps with normal maps), a surface with a color per vertex, or
points and cameras. The same model gives the same bytes. ReconstructionError: the model is empty, or has no triangles
and the format needs them."""


@dataclass(frozen=True, slots=True)
class Exporter:
    """A file format for models."""

    name: str
    write: WriteModel
    suffix: str
    """Suffix, without dot, of the file to open."""
    summary: str = ""
    unavailable: Callable[[], str] = str
    """Why this machine cannot write it; empty if it can."""
    holds_points: bool = True
    """Whether it stores points and cameras, too."""


class PerspectiveScene(Protocol):
    """The photos of a scene as pinhole cameras, at full size."""

    @property
    def photos(self) -> tuple[PerspectivePhoto, ...]:
        """All photos, by name."""

    def write_photos(self, folder: Path, /) -> None:
        """Write photos into `folder`/images, and masks, if any, into `folder`/masks."""

    def write_colmap(self, folder: Path, /, *, text: bool = False) -> None:
        """Write COLMAP's model into a new folder: cameras, poses, points and their tracks."""

    def write_bundle(self, file: Path, /) -> None:
        """Write Bundler's file by COLMAP; exact where K is that of `centered`."""


class FinishedScene(Protocol):
    """A scene in the frame of the export."""

    @property
    def scene(self) -> Scene:
        """Cameras and poses; `model_dir` is COLMAP's model in the run's own frame."""

    def points(self) -> PointCloud:
        """Return the sparse points."""

    def cloud(self) -> PointCloud:
        """Return the dense cloud."""

    def cloud_on_map(self) -> tuple[PointCloud, str]:
        """Return the dense cloud, z up in a system, and its WKT; as in `cloud` and empty where the place is unknown."""

    def perspective(self, *, centered: bool = False) -> PerspectiveScene:
        """Return the undistorted photos; `centered` turns them so that the optical center is in the middle."""

    def say(self, text: str, /) -> None:
        """Show the user a message."""


WriteScene = Callable[[FinishedScene, Path], None]
"""Writes a scene to a file, or into an empty folder; the same scene gives the same bytes."""


@dataclass(frozen=True, slots=True)
class SceneExporter:
    """A format for cameras, poses, points and photos."""

    name: str
    write: WriteScene
    summary: str = ""
    file: str = ""
    """Usual name of its file; empty if it fills a folder."""
    needs: str = SCENE
    """`SCENE` or `CLOUD`."""
    unavailable: Callable[[], str] = str

    @property
    def suffix(self) -> str:
        """Suffix of its file, without dot; empty for a folder."""
        return Path(self.file).suffix.removeprefix(".")


def missing_package(package: str, module: str) -> str:
    """Return that a package of the registry is not installed; "" if `module`, one of its modules, exists."""
    return "" if find_spec(module) else f"the package {package} is not installed"


def check_writable(model: Model) -> None:
    """Raise a ReconstructionError for a model without triangles and points, or with coordinates that are not finite."""
    if not len(model.surface.vertices):
        raise ReconstructionError("the model has no points to write", hint="take more photos with more overlap")
    if not np.isfinite(model.surface.vertices).all():
        raise ReconstructionError("coordinates of the model are not finite", hint="run again from the stage `scene`")


JPEG_QUALITY = 90
"""Quality of texture pages on libjpeg's scale: less shows blocks, more makes much larger files. By hand."""
NORMAL_QUALITY, NORMAL_SUFFIX, NORMAL_TYPE = 92, "jpg", "image/jpeg"
"""Quality and type of normal maps: shading is 1.7 degrees off on average (benchmarks/surface/normal_map.py)."""


def jpeg(page: ByteArray) -> bytes:
    """Return a texture page (H, W, 3) as JPEG, without chroma subsampling.

    Chroma subsampling smears colors across chart borders. At equal file size, full resolution is closer to the page.
    """
    try:
        return _encode(page, JPEG_QUALITY, optimize=True)
    except OSError:  # Pillow reserves a byte for each pixel; pages that are mostly noise take more
        return _encode(page, JPEG_QUALITY, optimize=False)


def normal_picture(page: ByteArray) -> bytes:
    """Return a normal map (H, W, 3) as a file of type `NORMAL_TYPE`."""
    return _encode(page, NORMAL_QUALITY, optimize=False)


def _encode(page: ByteArray, quality: int, *, optimize: bool) -> bytes:
    from PIL import Image

    file = io.BytesIO()
    Image.fromarray(page).save(file, "JPEG", quality=quality, subsampling="4:4:4", optimize=optimize)
    return file.getvalue()


def split_corners(faces: IndexArray, uv: Float32Array) -> tuple[IndexArray, Float32Array, IndexArray]:
    """Divide vertices on chart borders, so that each vertex has one texture coordinate, or C other values.

    Returns:
        Old vertex (N,) and texture coordinates (N, C) of each new vertex, sorted by old vertex; new faces (T, 3).
    """
    vertices, values = faces.ravel(), np.ascontiguousarray(uv, np.float32).reshape(faces.size, -1)
    order = np.lexsort((*values.T[::-1], vertices))
    is_first = np.ones(len(order), bool)
    is_first[1:] = (np.diff(vertices[order]) != 0) | (np.diff(values[order], axis=0) != 0).any(axis=1)
    new = np.empty(len(order), np.int64)
    new[order] = np.cumsum(is_first) - 1
    corners = order[is_first]
    return vertices[corners], values[corners], new.reshape(-1, 3)


def pages_in_use(pages: NDArray[np.int32]) -> list[int]:
    """Return the numbers of the pages that triangles lie on, ascending."""
    return [int(page) for page in np.unique(pages)]


def page_files(model: Model, name: str) -> dict[int, str]:
    """Return the files of the pages of texture in use by their numbers; empty without textured triangles."""
    if model.texture is None or not len(model.surface.faces):
        return {}
    stem = re.sub(r"\s", "_", name)  # many readers end file names at a blank
    return {page: f"{stem}_{page}.jpg" for page in pages_in_use(model.texture.page)}


def normal_file(picture: str) -> str:
    """Return the file of the normal map of a page of texture."""
    return f"{Path(picture).stem}_normals.{NORMAL_SUFFIX}"


def page_pictures(texture: Texture, pages: Mapping[int, str]) -> dict[str, bytes]:
    """Return the pictures of the pages of `page_files` and their normal maps, if any, by file."""
    pictures, maps = {file: jpeg(texture.pages[page]) for page, file in pages.items()}, texture.normal_maps
    return pictures | {normal_file(file): normal_picture(maps[page]) for page, file in pages.items() if maps}
