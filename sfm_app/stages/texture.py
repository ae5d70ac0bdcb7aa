"""texture: Scene, Surface and photos -> Model with a texture."""

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from sfm_app.context import RunContext
from sfm_app.meshing.occlusion import Occluders
from sfm_app.settings import TextureSettings
from sfm_app.texture import PhotoView, photo_view, texture_surface
from sfm_app.types import Model, Scene, Surface, Texture

TEXTURE = "texture.npz"


def make_texture(scene: Scene, surface: Surface, options: TextureSettings, run: RunContext) -> Model:
    """Paint the surface with the photos at full size, and keep it beside the depth maps."""
    hidden = Occluders(surface.vertices, surface.faces).hidden
    load = partial(read_photo, run.workspace.photos)
    model, figures = texture_surface(surface, photo_views(scene), load, hidden, options, run.map)
    run.record(**figures)
    save_texture(model, run)
    return model


def photo_views(scene: Scene) -> list[PhotoView]:
    """The registered photos as the texture sees them."""
    return [photo_view(name, scene.cameras[scene.camera_of[name]], pose) for name, pose in scene.cam_from_world.items()]


def read_photo(photo_dir: Path, view: PhotoView) -> NDArray[np.uint8]:
    """(height, width, 3) RGB of a photo at the size of the view; smaller ones are averaged, not picked."""
    with Image.open(photo_dir / view.name) as image:
        photo = image.convert("RGB")
    if photo.size != (view.width, view.height):
        photo = photo.resize((view.width, view.height), Image.Resampling.BOX)
    return np.asarray(photo)


def save_texture(model: Model, run: RunContext) -> None:
    """Write dense/texture.npz."""
    surface, texture = model.surface, model.texture
    stored: dict[str, Any] = {"vertices": surface.vertices, "faces": surface.faces, "colors": surface.colors}
    if texture is not None:
        stored |= {"uv": texture.uv, "page": texture.page}
        stored |= {f"page{number}": page for number, page in enumerate(texture.pages)}
    with run.workspace.replacing(run.workspace.dense / TEXTURE) as path:
        np.savez(path, **stored)


def load_texture(dense_dir: Path) -> Model:
    """The model that `make_texture` left in a dense workspace."""
    # opened here, because NumPy leaves a damaged file open
    with (dense_dir / TEXTURE).open("rb") as file, np.load(file) as stored:
        surface = Surface(stored["vertices"], stored["faces"], stored["colors"])
        if "uv" not in stored:
            return Model(surface)
        pages = tuple(stored[f"page{number}"] for number in range(sum(name[4:].isdigit() for name in stored.files)))
        return Model(surface, Texture(stored["uv"], stored["page"], pages))
