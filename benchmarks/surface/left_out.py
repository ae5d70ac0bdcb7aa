"""The model of a finished run without one of its photos: only what others saw can look right in its camera."""

import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from benchmarks.surface.photos import placed_photos
from sfm_app.api import open_run
from sfm_app.colmap.backend import pycolmap
from sfm_app.colmap.model import submodel
from sfm_app.products import read_scene, read_surface
from sfm_app.settings import Settings
from sfm_app.stages import depth_maps, mesh, texture
from sfm_app.types import Model


def remake_without(
    out: Path, target: Path, name: str, settings: Mapping[str, Any], *, geometry_too: bool = False
) -> Model:
    """Return the textured surface as it is without a photo, with cameras as they are.

    The stages are called by themselves: the program would see that the copy is not the run that it was, and make all
    of it again, with the photo.

    Args:
        out: the finished run.
        target: folder of the copy; its contents are removed.
        name: name of the photo.
        settings: those that differ from the defaults.
        geometry_too: whether depth maps and mesh leave it out as well, or the texture only.

    Raises:
        SfmError: there is no surface without it.
    """
    shutil.rmtree(target, ignore_errors=True)
    shutil.copytree(out, target, symlinks=True, ignore=shutil.ignore_patterns("dense", "texture"))
    others = [image.image_id for other, image in placed_photos(out).items() if other != name]
    submodel(pycolmap.Reconstruction(target / "sparse"), others).write(target / "sparse")
    with open_run(target, Settings.from_mapping(settings), None) as run:
        own = run.with_fingerprint(f"without {name}")
        left = read_scene(own.workspace)
        if geometry_too:
            shutil.rmtree(target / "surface")
            surface = mesh.make(left, depth_maps.make(left, own), own)
        else:
            surface = read_surface(own.workspace)
        (target / "texture").mkdir()
        return texture.make(left, surface, own)
