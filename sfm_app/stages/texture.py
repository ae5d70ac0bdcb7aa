"""texture: Scene, Surface and photos -> Model with a texture."""

import shutil
from collections.abc import Mapping
from hashlib import blake2b
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from sfm_app.files import digest_files, fingerprint, load_arrays, mark_unfinished, replace_atomically, resume_or_clear
from sfm_app.meshing.ray_casting import NearestNormals, Occluders
from sfm_app.photos import fill_masked, read_mask
from sfm_app.photos.panoramas import mask_part, panorama_parts, show_part
from sfm_app.runtime.context import RunContext
from sfm_app.runtime.workspace import Workspace
from sfm_app.texture import PhotoView, bake_normals, part_view, photo_view, texture_surface
from sfm_app.types import Model, Scene, Surface, Texture

TEXTURE = "texture.npz"
PANORAMA = "EQUIRECTANGULAR"
"""COLMAP's name of the camera model of panoramas."""
NORMALS = "normals"
"""Name of a normal map in the file, before its page."""
PARTS = "parts"
"""Folder beside it while the texture is made: the finished work on each photo."""


def make(scene: Scene, surface: Surface, run: RunContext) -> Model:
    """Paint the surface with the photos at full size.

    A killed run can resume.
    """
    views, parts = photo_views(scene), run.workspace.texture / PARTS
    cameras = [(view.name, view.row.tolist(), view.width, view.height) for view in views]
    made_from = fingerprint(run.fingerprint, cameras, surface_digest(surface))
    if not resume_or_clear(parts, made_from):
        mark_unfinished(parts, made_from)
    hidden = Occluders(surface.vertices, surface.faces).is_hidden
    store = FileStore(run.workspace.photos, parts, run.mask_dir)
    options = run.settings.texture
    if not run.settings.mesh.trim:  # who wants a closed surface wants no borders
        options = options.model_copy(update={"trim_borders": False})
    model, figures = texture_surface(surface, views, store, hidden, options, run.map)
    run.record(**figures)
    model = _add_normal_map(model, run) if run.settings.texture.normal_map else model
    save_texture(model, run)
    shutil.rmtree(parts)
    return model


def _add_normal_map(model: Model, run: RunContext) -> Model:
    """Return the model with the detail of the fine surface, as the mesh stage has kept it."""
    fine = load_arrays(run.workspace.fine_surface)
    found, share = bake_normals(model, NearestNormals(fine["vertices"], fine["faces"]).find, run.map)
    run.record(normal_map_share=round(share, 4))
    return found


class FileStore:
    """The `sfm_app.texture.Store` of a run: photos and masks of two folders, and arrays in files."""

    def __init__(self, photo_dir: Path, folder: Path, mask_dir: Path | None = None) -> None:
        self.photo_dir, self.folder, self.mask_dir = photo_dir, folder, mask_dir

    def photo(self, view: PhotoView) -> NDArray[np.uint8]:
        """Return (height, width, 3) RGB of a view, without what is masked."""
        return read_photo(self.photo_dir, view, self.usable_pixels(view))

    def usable_pixels(self, view: PhotoView) -> NDArray[np.bool_] | None:
        """Return a (height, width) mask of the pixels that may be used; None where no masks are given."""
        if self.mask_dir is None:
            return None
        used = read_mask(self.mask_dir, view.source)
        return used if view.part is None else mask_part(used, view.part)

    def recall(self, name: str) -> dict[str, NDArray[np.generic]] | None:
        """Return the arrays that were kept under a name, if they are there and sound."""
        try:
            return load_arrays(self._path(name))
        except Exception:  # missing, or damaged: decoders raise all kinds of errors
            return None

    def keep(self, name: str, arrays: Mapping[str, NDArray[np.generic]]) -> None:
        """Keep arrays in a file, written atomically."""
        with replace_atomically(self._path(name)) as path:
            np.savez(path, allow_pickle=False, **arrays)

    def _path(self, name: str) -> Path:
        return self.folder / f"{name}.npz"


def surface_digest(surface: Surface) -> str:
    """Return a hash of vertices, triangles and colors."""
    found = blake2b()
    for part in (surface.vertices, surface.faces, surface.colors):
        found.update(part.tobytes())
    return found.hexdigest()


def photo_views(scene: Scene) -> list[PhotoView]:
    """Return the views of the registered photos for texturing; a panorama has several."""
    found = list[PhotoView]()
    for name, pose in scene.cam_from_world.items():
        camera = scene.cameras[scene.camera_of[name]]
        if camera.model != PANORAMA:
            found.append(photo_view(name, camera, pose))
            continue
        views = panorama_parts((camera.width, camera.height))
        found += [part_view(f"{name}.{number + 1}", name, view, pose) for number, view in enumerate(views)]
    return found


def read_photo(photo_dir: Path, view: PhotoView, used: NDArray[np.bool_] | None = None) -> NDArray[np.uint8]:
    """Return (height, width, 3) RGB of a photo at the size of the view; it is scaled down by averaging.

    Args:
        used: (H, W) pixels of the view that may be seen; None for all.
    """
    with Image.open(photo_dir / view.source) as image:
        photo = np.asarray(image.convert("RGB"))
    if view.part is not None:
        photo = show_part(photo, view.part)
    if used is not None:
        photo = fill_masked(photo, used)
    if photo.shape[1::-1] != (view.width, view.height):
        shown = Image.fromarray(photo).resize((view.width, view.height), Image.Resampling.BOX)
        photo = np.asarray(shown)
    return photo


def save_texture(model: Model, run: RunContext) -> None:
    """Write texture/texture.npz."""
    surface, texture = model.surface, model.texture
    stored: dict[str, Any] = {"vertices": surface.vertices, "faces": surface.faces, "colors": surface.colors}
    if texture is not None:
        stored |= {"uv": texture.uv, "page": texture.page}
        stored |= {f"page{number}": page for number, page in enumerate(texture.pages)}
        stored |= {f"{NORMALS}{number}": page for number, page in enumerate(texture.normal_maps)}
    with replace_atomically(run.workspace.texture / TEXTURE) as path:
        np.savez(path, **stored)


def load(run: RunContext) -> Model:
    """Read the surface with its texture back."""
    return read_texture(run.workspace)


def digest(place: Workspace) -> str:
    """Return a hash of the surface with its texture."""
    return digest_files(place.texture, TEXTURE)


def read_texture(place: Workspace) -> Model:
    """Read the surface with its texture from an output folder."""
    stored = load_arrays(place.texture / TEXTURE)
    surface = Surface(stored["vertices"], stored["faces"], stored["colors"])
    if "uv" not in stored:
        return Model(surface)
    pages, normals = _list_numbered(stored, "page"), _list_numbered(stored, NORMALS)
    return Model(surface, Texture(stored["uv"], stored["page"], pages, normals))


def _list_numbered(stored: Mapping[str, NDArray[Any]], kind: str) -> tuple[NDArray[Any], ...]:
    """Return the arrays whose names are a kind and a number, from 0 on."""
    found = list[NDArray[Any]]()
    while (array := stored.get(f"{kind}{len(found)}")) is not None:
        found.append(array)
    return tuple(found)
