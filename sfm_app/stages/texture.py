"""texture: Scene, Surface and photos -> Model with a texture."""

import shutil
from collections.abc import Mapping
from hashlib import blake2b
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from sfm_app.files import fingerprint, load_arrays, mark_unfinished, replace_atomically, resume_or_clear
from sfm_app.meshing.ray_casting import NearestNormals
from sfm_app.photos.decode import fill_masked
from sfm_app.photos.masks import read_mask
from sfm_app.photos.panoramas import mask_part, panorama_parts, show_part
from sfm_app.products import write_texture
from sfm_app.runtime.context import RunContext
from sfm_app.texture.assemble import texture_surface
from sfm_app.texture.normal_map import bake_normals
from sfm_app.texture.views import PhotoView, part_view, photo_view
from sfm_app.types import Model, Scene, Surface
from sfm_app.types.arrays import BoolArray, ByteArray

PARTS = "parts"
"""Folder of the finished work on each photo, while the texture is made."""


def make(scene: Scene, surface: Surface, run: RunContext) -> Model:
    """Paint the surface with the photos at full size; a killed run can resume."""
    views, parts = photo_views(scene), run.workspace.texture / PARTS
    cameras = [(view.name, view.row.tolist(), view.width, view.height) for view in views]
    made_from = fingerprint(run.fingerprint, cameras, surface_digest(surface))
    if not resume_or_clear(parts, made_from):
        mark_unfinished(parts, made_from)
    store = FileStore(run.workspace.photos, parts, run.mask_dir)
    options = run.settings.texture
    model, figures = texture_surface(surface, views, store, options, run.map)
    run.record(**figures)
    model = _add_normal_map(model, run) if run.settings.texture.normal_map else model
    write_texture(model, run.workspace)
    shutil.rmtree(parts)
    return model


def _add_normal_map(model: Model, run: RunContext) -> Model:
    """Return the model with normal maps of the fine surface, which the mesh stage keeps."""
    fine = load_arrays(run.workspace.fine_surface)
    detailed, share = bake_normals(model, NearestNormals(fine["vertices"], fine["faces"]).find, run.map)
    run.record(normal_map_share=round(share, 4))
    return detailed


class FileStore:
    """The `sfm_app.texture.pages.Store` of a run: photos and masks of two folders, and arrays in files."""

    def __init__(self, photo_dir: Path, folder: Path, mask_dir: Path | None = None) -> None:
        self.photo_dir, self.folder, self.mask_dir = photo_dir, folder, mask_dir

    def photo(self, view: PhotoView) -> ByteArray:
        """Return the RGB picture (H, W, 3) of a view, scaled down by averaging; masked pixels are filled."""
        with Image.open(self.photo_dir / view.photo) as image:
            photo = np.asarray(image.convert("RGB"))
        if view.part is not None:
            photo = show_part(photo, view.part)
        used = self.usable_pixels(view)
        if used is not None:
            photo = fill_masked(photo, used)
        if photo.shape[1::-1] != (view.width, view.height):
            photo = np.asarray(Image.fromarray(photo).resize((view.width, view.height), Image.Resampling.BOX))
        return photo

    def usable_pixels(self, view: PhotoView) -> BoolArray | None:
        """Return the usable pixels (H, W) of a view; None without masks."""
        if self.mask_dir is None:
            return None
        used = read_mask(self.mask_dir, view.photo)
        return used if view.part is None else mask_part(used, view.part)

    def recall(self, name: str) -> dict[str, NDArray[np.generic]] | None:
        """Return the arrays of a file; None if it is missing or damaged."""
        try:
            return load_arrays(self._path(name))
        except Exception:  # decoders of damaged bytes raise anything
            return None

    def keep(self, name: str, arrays: Mapping[str, NDArray[np.generic]]) -> None:
        """Write arrays to a file, atomically."""
        with replace_atomically(self._path(name)) as path:
            np.savez(path, allow_pickle=False, **arrays)

    def _path(self, name: str) -> Path:
        return self.folder / f"{name}.npz"


def surface_digest(surface: Surface) -> str:
    """Return a hash of vertices, triangles and colors."""
    hasher = blake2b()
    for array in (surface.vertices, surface.faces, surface.colors):
        hasher.update(array.tobytes())
    return hasher.hexdigest()


def photo_views(scene: Scene) -> list[PhotoView]:
    """Return the views of the registered photos; a panorama has several."""
    photos = list[PhotoView]()
    for name, pose in scene.cam_from_world.items():
        camera = scene.cameras[scene.camera_of[name]]
        if camera.model != "EQUIRECTANGULAR":
            photos.append(photo_view(name, camera, pose))
            continue
        parts = panorama_parts((camera.width, camera.height))
        photos += [part_view(f"{name}.{number}", name, part, pose) for number, part in enumerate(parts, 1)]
    return photos
