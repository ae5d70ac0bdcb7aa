"""What a file format is: one for models, or one for whole scenes with their photos."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Protocol

from sfm_app.types import Model, Scene
from sfm_app.types.exported import PerspectivePhoto, PointCloud

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
