"""Products of the stages in an output folder: how each is written, read, and hashed to detect damage.

Readers raise an OSError, a ValueError or an SfmError for files that are missing or damaged. A hash is compared before
its files are read, because COLMAP hangs on some damaged ones.
"""

import json
import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sfm_app.colmap.backend import Reconstruction, check_written, translate_errors
from sfm_app.colmap.database import digest_matches, is_sound, read_match_graph
from sfm_app.colmap.model import read_scene as read_colmap_scene
from sfm_app.files import digest_files, is_below, load_arrays, replace_atomically, replace_folder
from sfm_app.frame.scale import MetricFrame, read_place
from sfm_app.numerical import json_text
from sfm_app.runtime.workspace import Workspace
from sfm_app.types import (
    Intrinsics,
    MatchGraph,
    Model,
    Photo,
    PhotoSet,
    Scene,
    Surface,
    Texture,
    UnusablePhoto,
    ViewGraph,
)


def _write_json(path: Path, values: Mapping[str, Any]) -> None:
    with replace_atomically(path) as beside:
        beside.write_text(json_text(values), encoding="utf-8", newline="\n")


def _read_json(path: Path) -> Any:
    return json.loads(path.read_text(encoding="utf-8"))


def hash_files(*names: str) -> Callable[[Workspace], str]:
    """Return the function that hashes these files, and those in these folders, of an output folder."""
    return lambda place: digest_files(place.root, *names)


# photos.json: the photos, those left out, and hashes of the 8-bit copies.


def write_photo_list(photos: PhotoSet, copies: Mapping[str, str | None], place: Workspace) -> None:
    """Write photos.json; `copies` are the hashes of 8-bit copies by name, None for photos without one."""
    unusable = [asdict(photo) for photo in photos.unusable]
    values = {"photos": [photo.to_dict() for photo in photos.photos], "unusable": unusable, "copies": copies}
    _write_json(place.photo_set, values)


def read_photo_list(place: Workspace) -> PhotoSet:
    """Return the photos, without a look at their files; raise a ValueError if one lies outside of the folder."""
    values = _read_json(place.photo_set)
    photos = tuple(Photo.from_dict(entry) for entry in values["photos"])
    if not all(is_below(photo.name) for photo in photos):
        raise ValueError(f"{place.photo_set} names photos outside of their folder")
    return PhotoSet(place.photos, photos, tuple(UnusablePhoto(**photo) for photo in values["unusable"]))


def read_copy_hashes(place: Workspace) -> Mapping[str, str | None]:
    """Return the hashes of 8-bit copies by name."""
    copies: Mapping[str, str | None] = _read_json(place.photo_set)["copies"]
    return copies


hash_photos = hash_files("photos.json")
"""It holds hashes of the copies."""


# database.db: keypoints and matches. COLMAP writes it.


def read_matches(photos: PhotoSet, place: Workspace) -> MatchGraph:
    """Return the match graph of these photos."""
    if not is_sound(place.database):
        raise ValueError(f"{place.database} is damaged")
    with translate_errors("reading the database"):
        return read_match_graph(place.database, photos)


def hash_matches(place: Workspace) -> str:
    """Return a hash of the photos, keypoints and matches in the database."""
    return digest_matches(place.database)


# view_graph.npz: fundamental matrices and lenses.


def write_view_graph(graph: ViewGraph, place: Workspace) -> None:
    """Write view_graph.npz."""
    with replace_atomically(place.view_graph) as path:
        np.savez_compressed(path, allow_pickle=False, **graph.to_arrays())


def read_view_graph(place: Workspace) -> ViewGraph:
    """Return the fundamental matrices and lenses."""
    return ViewGraph.from_arrays(load_arrays(place.view_graph))


hash_view_graph = hash_files("view_graph.npz")


# calibration.json: the cameras before mapping.


def write_intrinsics(intrinsics: Intrinsics, place: Workspace) -> None:
    """Write calibration.json."""
    _write_json(place.calibration, intrinsics.to_dict())


def read_intrinsics(place: Workspace) -> Intrinsics:
    """Return the cameras before mapping."""
    return Intrinsics.from_dict(_read_json(place.calibration))


hash_intrinsics = hash_files("calibration.json")


# sparse/ and scene.json: COLMAP's model, and what it cannot hold.


def write_sparse_models(models: Sequence[Reconstruction], place: Workspace) -> None:
    """Write the main model, the first, to OUT/sparse and the others to OUT/other_models/1, 2, ..., each atomically."""
    shutil.rmtree(place.other_models, ignore_errors=True)
    targets = (place.sparse, *(place.other_models / str(number) for number in range(1, len(models))))
    for model, target in reversed(list(zip(models, targets, strict=True))):  # the main model is last
        with replace_folder(target) as draft, translate_errors("writing the sparse model"):
            model.write(draft)
            check_written(*draft.iterdir())


def write_scene(scene: Scene, place: Workspace) -> None:
    """Write scene.json."""
    values = {
        "cameras": {name: camera.to_dict() for name, camera in scene.cameras.items()},
        "camera_of": dict(scene.camera_of),
        "unregistered": dict(scene.unregistered),
        "gps_deviation": scene.gps_deviation,
        "gps_place": scene.gps_place and asdict(scene.gps_place),
    }
    _write_json(place.scene, values)


def read_scene(place: Workspace) -> Scene:
    """Return the scene of the main model."""
    values = _read_json(place.scene)
    with translate_errors("reading the sparse model"):
        scene = read_colmap_scene(place.sparse, values["camera_of"], values["unregistered"], values["cameras"])
    return replace(scene, gps_deviation=values.get("gps_deviation"), gps_place=read_place(values.get("gps_place")))


hash_scene = hash_files("sparse", "scene.json")


# scale.json: the frame of exported files.


def write_frame(frame: MetricFrame, place: Workspace) -> None:
    """Write scale.json."""
    _write_json(place.scale, frame.to_dict())


def read_frame(place: Workspace) -> MetricFrame:
    """Return the frame of exported files."""
    return MetricFrame.from_dict(_read_json(place.scale))


hash_frame = hash_files("scale.json")


# surface/surface.npz, and surface/fine.npz for normal maps.

SURFACE = "surface.npz"


def write_surface(surface: Surface, place: Workspace) -> None:
    """Write surface.npz."""
    with replace_atomically(place.surface / SURFACE) as path:
        np.savez(path, vertices=surface.vertices, faces=surface.faces, colors=surface.colors)


def read_surface(place: Workspace) -> Surface:
    """Return the surface."""
    stored = load_arrays(place.surface / SURFACE)
    return Surface(stored["vertices"], stored["faces"], stored["colors"])


def hash_surface(place: Workspace) -> str:
    """Return a hash of the surface, and of the fine surface if it is kept."""
    fine = place.fine_surface
    return digest_files(place.surface, SURFACE, *([fine.name] if fine.exists() else []))


# texture/texture.npz: the surface with its texture.

TEXTURE = "texture.npz"
NORMALS = "normals"
"""Prefix of normal maps in the file, before the number of the page."""


def write_texture(model: Model, place: Workspace) -> None:
    """Write texture.npz."""
    surface, texture = model.surface, model.texture
    stored: dict[str, Any] = {"vertices": surface.vertices, "faces": surface.faces, "colors": surface.colors}
    if texture is not None:
        stored |= {"uv": texture.uv, "page": texture.page}
        stored |= {f"page{number}": page for number, page in enumerate(texture.pages)}
        stored |= {f"{NORMALS}{number}": page for number, page in enumerate(texture.normal_maps)}
    with replace_atomically(place.texture / TEXTURE) as path:
        np.savez(path, **stored)


def read_texture(place: Workspace) -> Model:
    """Return the surface with its texture."""
    stored = load_arrays(place.texture / TEXTURE)
    surface = Surface(stored["vertices"], stored["faces"], stored["colors"])
    if "uv" not in stored:
        return Model(surface)
    pages, normals = _list_numbered(stored, "page"), _list_numbered(stored, NORMALS)
    return Model(surface, Texture(stored["uv"], stored["page"], pages, normals))


def _list_numbered(stored: Mapping[str, NDArray[Any]], kind: str) -> tuple[NDArray[Any], ...]:
    arrays = list[NDArray[Any]]()
    while (array := stored.get(f"{kind}{len(arrays)}")) is not None:
        arrays.append(array)
    return tuple(arrays)


def hash_texture(place: Workspace) -> str:
    """Return a hash of the surface with its texture."""
    return digest_files(place.texture, TEXTURE)
