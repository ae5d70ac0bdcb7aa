"""Texture pages and normal maps as files, and the vertices of their triangles."""

import io
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from sfm_app.errors import ReconstructionError
from sfm_app.types import Model, Scene
from sfm_app.types.arrays import IndexArray
from sfm_app.types.scene import PerspectivePhoto, PointCloud

# What a file format is: one for models, or one for whole scenes with their photos.

INSTALL_HINT = "pip install 'sfm-app[export]'"
SCENE, CLOUD = "scene", "cloud"
"""What a format for scenes needs of a run: cameras, poses and sparse points; or the dense cloud, too."""


class WriteModel(Protocol):
    """Makes model files by name: first the one to open (`name` with the format's suffix), then those it refers to.

    Takes a surface with a texture (pages of pictures, perhaps with normal maps), a surface with a color per vertex, or
    points and cameras; the same model gives the same bytes. ReconstructionError where the model is empty, or has no
    triangles and the format holds nothing else.
    """

    def __call__(self, model: Model, name: str, /) -> Mapping[str, bytes]: ...


def _no_reason() -> str:
    return ""


@dataclass(frozen=True, slots=True)
class Exporter:
    """A file format for models."""

    name: str
    write: WriteModel
    summary: str = ""
    suffix: str = ""
    """Suffix, without dot, of the file to open; empty where it is the name."""
    unavailable: Callable[[], str] = _no_reason
    """Why it cannot be written on this machine; empty where it can."""

    holds_points: bool = True
    """Whether it holds points and cameras, too."""

    @property
    def ending(self) -> str:
        """Suffix, without dot, of the file to open."""
        return self.suffix or self.name


class PerspectiveScene(Protocol):
    """The photos of a scene as pinhole cameras, at full size."""

    @property
    def photos(self) -> tuple[PerspectivePhoto, ...]:
        """All of them, by name of the photo."""

    def write_photos(self, folder: Path, /) -> None:
        """Write them into `folder`/images, and their masks, if any, into `folder`/masks."""

    def write_colmap(self, folder: Path, /, *, text: bool = False) -> None:
        """Write COLMAP's model of them: cameras, poses, points, and where photos see them.

        Args:
            folder: created.
            text: whether as text instead of binary.
        """

    def write_bundle(self, file: Path, /) -> None:
        """Write Bundler's file of them by COLMAP; exact where K is that of `centered`."""


class FinishedScene(Protocol):
    """What a format for scenes is made from; everything is in the frame of the export."""

    @property
    def scene(self) -> Scene:
        """Cameras and poses; `model_dir` is COLMAP's model in the run's own frame."""

    def points(self) -> PointCloud:
        """Return the sparse points."""

    def cloud(self) -> PointCloud:
        """Return the dense cloud."""

    def perspective(self, *, centered: bool = False) -> PerspectiveScene:
        """Return the photos undistorted, with `centered` turned so that the optical center is in the middle."""

    def say(self, text: str, /) -> None:
        """Show the user a message."""


class WriteScene(Protocol):
    """Writes a scene to a path: a file, or a folder that is there and empty; the same scene gives the same bytes."""

    def __call__(self, scene: FinishedScene, target: Path, /) -> None: ...


@dataclass(frozen=True, slots=True)
class SceneExporter:
    """A format for cameras, poses, points and photos."""

    name: str
    write: WriteScene
    summary: str = ""
    file: str = ""
    """Usual name of the file that it writes; empty where it fills a folder."""
    needs: str = SCENE
    """`SCENE` or `CLOUD`."""
    unavailable: Callable[[], str] = _no_reason
    """Why it cannot be written on this machine; empty where it can."""

    @property
    def ending(self) -> str:
        """Suffix, without dot, of the file that it writes; empty for a folder."""
        return Path(self.file).suffix.removeprefix(".")


def missing_package(package: str, module: str) -> str:
    """Return that a package is not installed; empty where it is.

    Args:
        package: its name in the registry.
        module: one that it installs.
    """
    return "" if find_spec(module) else f"the package {package} is not installed"


# Checks that all file formats share.


def check(model: Model) -> None:
    """Check that a model can be written.

    Raises:
        ReconstructionError: there is neither a triangle nor a point, or coordinates are not finite.
    """
    if not len(model.surface.vertices):
        raise ReconstructionError(
            "there is nothing to write: the model has no points", hint="take more photos with more overlap"
        )
    if not np.isfinite(model.surface.vertices).all():
        raise ReconstructionError("coordinates of the model are not finite", hint="run again from the stage `scene`")


JPEG_QUALITY = 90
"""Quality of texture pages on libjpeg's scale: lower values show blocks, higher ones make much larger files."""

NORMAL_QUALITY, NORMAL_SUFFIX, NORMAL_TYPE = 92, "jpg", "image/jpeg"
"""Quality and kind of normal maps. Chosen on fountain-P11 (benchmarks/surface/normal_map.py): 0.5 MB, and shading 1.7
degrees off on average; PNG takes 1.3 MB for 1.1 degrees, quality 80 takes 0.3 MB for 2.2 degrees."""


def jpeg(page: NDArray[np.uint8]) -> bytes:
    """Return a texture page (H, W, 3) as JPEG, without chroma subsampling.

    JPEG's usual chroma subsampling smears colors across the borders of charts: on the page of a brick wall it costs
    3 dB. At equal file size, full resolution with lower quality is 1.5 dB closer to the page.
    """
    try:
        return _encode(page, JPEG_QUALITY, optimize=True)
    except OSError:  # Pillow reserves a byte for each pixel; pages that are mostly noise take more
        return _encode(page, JPEG_QUALITY, optimize=False)


def normal_picture(page: NDArray[np.uint8]) -> bytes:
    """Return a normal map (H, W, 3) as a file, of the kind that `NORMAL_SUFFIX` names."""
    return _encode(page, NORMAL_QUALITY, optimize=False)


def _encode(page: NDArray[np.uint8], quality: int, *, optimize: bool) -> bytes:
    from PIL import Image

    file = io.BytesIO()
    Image.fromarray(page).save(file, "JPEG", quality=quality, subsampling="4:4:4", optimize=optimize)
    return file.getvalue()


def split_corners(faces: IndexArray, uv: NDArray[np.float32]) -> tuple[IndexArray, NDArray[np.float32], IndexArray]:
    """Divide vertices on chart borders, so that each vertex has one texture coordinate.

    Args:
        faces: (T, 3) vertex indices.
        uv: (T, 3, C) texture coordinates of their corners, and whatever else may differ there.

    Returns:
        For each of N new vertices, in the order of the old ones: the old vertex (N,) and the texture coordinates
        (N, C); and the faces (T, 3) of new vertices.
    """
    at, place = faces.ravel(), np.ascontiguousarray(uv, np.float32).reshape(faces.size, -1)
    order = np.lexsort((*place.T[::-1], at))
    first = np.ones(len(order), bool)
    first[1:] = (np.diff(at[order]) != 0) | (np.diff(place[order], axis=0) != 0).any(axis=1)
    new = np.empty(len(order), np.int64)
    new[order] = np.cumsum(first) - 1
    kept = order[first]
    return at[kept], place[kept], new.reshape(-1, 3)


def pages_in_use(pages: NDArray[np.int32]) -> list[int]:
    """Return the numbers of the pages that triangles lie on, ascending."""
    return [int(page) for page in np.unique(pages)]
