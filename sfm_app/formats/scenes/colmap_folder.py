"""COLMAP's folder layout of undistorted photos, which Gaussian-splatting trainers read, and Bundler's files."""

from pathlib import Path

from sfm_app.formats.exporters import FinishedScene

MODEL = "sparse/0"


def write_colmap(scene: FinishedScene, target: Path) -> None:
    """Write undistorted photos and COLMAP's binary model.

    Args:
        scene: the finished scene.
        target: folder to fill.
    """
    _write_folder(scene, target)


def write_colmap_text(scene: FinishedScene, target: Path) -> None:
    """Write undistorted photos and COLMAP's model as text.

    Args:
        scene: the finished scene.
        target: folder to fill.
    """
    _write_folder(scene, target, text=True)


def write_splat(scene: FinishedScene, target: Path) -> None:
    """Write what `write_colmap` does, with every optical center in the middle of its photo.

    Some trainers read the focal length only. A crop around the optical center would lose much of a cropped photo, so
    the photo is turned instead, as if the camera had looked at its middle.

    Args:
        scene: the finished scene.
        target: folder to fill.
    """
    _write_folder(scene, target, centered=True)


def write_bundler(scene: FinishedScene, target: Path) -> None:
    """Write Bundler's file by COLMAP's own writer, the list of photos, and the photos.

    Bundler has one focal length, and takes the optical center for the middle.

    Args:
        scene: the finished scene.
        target: folder to fill.
    """
    found = scene.perspective(centered=True)
    found.write_photos(target)
    found.write_bundle(target / "bundle.out")
    lines = "".join(f"images/{photo.image}\n" for photo in found.photos)
    (target / "list.txt").write_text(lines, encoding="ascii", newline="\n")


def _write_folder(scene: FinishedScene, target: Path, *, text: bool = False, centered: bool = False) -> None:
    found = scene.perspective(centered=centered)
    found.write_photos(target)
    found.write_colmap(target / MODEL, text=text)
