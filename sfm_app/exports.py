"""Export finished runs: cameras, points, photos and surface in the frame of the export.

Only this module moves poses, points and vertices into that frame. InputError where stages have not run, or their files
or photos are missing or damaged, and where a target holds files that no export has written.
"""

import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import cached_property, partial
from pathlib import Path, PurePosixPath

import numpy as np
from numpy.typing import NDArray

from sfm_app.colmap.backend import Reconstruction, translate_errors
from sfm_app.colmap.dense import shrink_mask
from sfm_app.colmap.model import model_arrays, posed_images, read_model, sparse_model
from sfm_app.colmap.perspective import (
    PixelMaps,
    all_points,
    full_size_lenses,
    perspective_photos,
    write_bundle,
    write_view_model,
)
from sfm_app.colmap.surface import FUSED, open_points, positions
from sfm_app.colmap.wide_views import ViewNames, WideLens, render_views, save_picture
from sfm_app.engine.stage import Products, Stage, check_undamaged, resume_hint
from sfm_app.errors import InputError
from sfm_app.files import RECORD, read_object, recorded_files, replace_atomically, replace_folder, save_files
from sfm_app.formats.scenes import plain_names
from sfm_app.frame.coordinates import MapFrame
from sfm_app.frame.scale import GPS, MetricFrame, map_entry, move_model
from sfm_app.frame.sighted_points import Distance, PosedPhotos, measure_distance
from sfm_app.frame.volumes import Volume, measure_volume
from sfm_app.geometry.poses import Similarity
from sfm_app.geometry.triangles import select_faces
from sfm_app.numerical import json_text
from sfm_app.operating_system import is_link
from sfm_app.photos.masks import mask_path, save_mask
from sfm_app.pipeline import MESH, SCALE, SCENE, TEXTURE
from sfm_app.products import read_photo_list
from sfm_app.runtime.context import RunContext
from sfm_app.types import Model, Scene, SceneArrays, Surface, Texture
from sfm_app.types.arrays import BoolArray, FloatArray
from sfm_app.types.scene import PerspectivePhoto, PointCloud
from sfm_app.wording import list_names

EMPTY_BOX, BOX_HINT = "nothing of the model is in the box", "its corners are in the frame of OUT/model.glb"
COLORS, NORMALS = ("red", "green", "blue"), ("nx", "ny", "nz")
"""Fields of the dense cloud."""


def stored_frame(run: RunContext) -> MetricFrame:
    """Return the frame of a run's exports; without a known scale, that of its model."""
    if run.workspace.manifest.record(SCALE.name) is not None:
        return Products(run)[SCALE]
    known = run.workspace.manifest.record(SCENE.name) is not None
    scene = Products(run)[SCENE] if known else None
    if scene is None or scene.gps_deviation is None:
        return MetricFrame()
    return MetricFrame(deviation=scene.gps_deviation, source=GPS, place=scene.gps_place)


def record_map(run: RunContext, folder: Path) -> None:
    """Write the place of exported files on the map into the record beside them, and remove that of an earlier run."""
    known = read_object(folder / RECORD)
    record = {key: value for key, value in known.items() if key != "map"} | map_entry(stored_frame(run).place)
    if record != known:
        save_files({RECORD: json_text(record).encode()}, folder)


def export_frame(run: RunContext) -> Similarity | None:
    """Return the similarity from the frame of the run's model into that of its exports; None if they are the same."""
    frame = stored_frame(run)
    return frame.from_model if frame.changes else None


def check_finished(run: RunContext, stages: Sequence[Stage[object]], what: str, otherwise: str = "") -> None:
    """Check that stages of a run are finished (InputError); messages say `what` is exported, hints what `otherwise`."""
    place = run.workspace
    place.manifest.check_begun()
    for stage in stages:
        if place.manifest.record(stage.name) is None:
            more = f"; {otherwise}" if otherwise and place.manifest.record(SCENE.name) else ""
            message = f"{place.root} holds no {what} yet: stage `{stage.name}` is missing"
            raise InputError(message, hint=resume_hint(run) + more)


def stored_model(run: RunContext, *, points: bool = False) -> Model:
    """Read the finished model, or the points and cameras, of a run."""
    if not points:
        check_finished(run, [TEXTURE], "model", "`--points` exports the points and cameras")
        return move_model(Products(run)[TEXTURE], stored_frame(run).from_model)
    check_finished(run, [SCENE], "points")
    with check_undamaged(SCENE, run):
        return move_model(sparse_model(run.workspace.sparse), stored_frame(run).from_model)


def crop(model: Model, box: FloatArray) -> Model:
    """Return what lies in a box, (2, 3) with the least and the greatest coordinates; InputError where nothing does.

    Triangles across its sides go.
    """
    surface, texture = model.surface, model.texture
    inside = in_box(surface.vertices, box)
    if not len(surface.faces):
        return replace(model, surface=Surface(surface.vertices[inside], surface.faces, surface.colors[inside]))
    keep = np.asarray(inside[surface.faces].all(axis=1))
    if not keep.any():
        raise InputError(EMPTY_BOX, hint=BOX_HINT)
    if texture is not None:
        used, page = np.unique(texture.page[keep], return_inverse=True)
        pages = tuple(texture.pages[number] for number in used)
        maps = tuple(texture.normal_maps[number] for number in used if texture.normal_maps)
        texture = Texture(texture.uv[keep], page.astype(np.int32), pages, maps)
    return replace(model, surface=select_faces(surface, keep), texture=texture)


def in_box(points: FloatArray, box: FloatArray) -> BoolArray:
    """Return which points (N, 3) lie in a box, as above; InputError if none does."""
    inside = np.asarray(((points >= box[0]) & (points <= box[1])).all(axis=1))
    if not inside.any():
        raise InputError(EMPTY_BOX, hint=BOX_HINT)
    return inside


def stored_scene(run: RunContext) -> tuple[Scene, Reconstruction]:
    """Read cameras and poses, and COLMAP's model with the points."""
    check_finished(run, [SCENE], "cameras and points")
    scene = Products(run)[SCENE]
    model = read_model(scene.model_dir, export_frame(run))
    poses = {image.name: np.asarray(image.cam_from_world().matrix(), np.float64) for image in posed_images(model)}
    return replace(scene, cam_from_world=poses), model


def stored_arrays(run: RunContext) -> SceneArrays:
    """Read poses, cameras, points and tracks as plain arrays, in the frame of exports."""
    _, model = stored_scene(run)
    return model_arrays(model, metric=stored_frame(run).is_metric)


def stored_distance(run: RunContext, ends: FloatArray) -> Distance:
    """Return the distance between two places, (2, 3) in the frame of exports; ValueError if both are the same."""
    check_finished(run, [SCENE], "camera poses")
    frame = stored_frame(run)
    a, b = frame.from_model.inverse()(ends)
    with check_undamaged(SCENE, run):
        model = PosedPhotos(run.workspace.sparse).sightlines()
    return measure_distance(a, b, model, frame.from_model.scale, frame.deviation)


def stored_volume(run: RunContext, corners: FloatArray) -> Volume:
    """Return the volumes within a polygon, (N, 3) in the frame of exports; ValueError as in `measure_volume`."""
    check_finished(run, [SCENE, MESH], "surface")
    frame = stored_frame(run)
    with check_undamaged(SCENE, run):
        model = PosedPhotos(run.workspace.sparse).sightlines()
    surface = Products(run)[MESH]
    move = frame.from_model
    model = replace(model, centers=move(model.centers), points=move(model.points))
    return measure_volume(corners, replace(surface, vertices=move(surface.vertices)), model, frame.deviation)


def check_cloud(run: RunContext) -> Path:
    """Return the file of the dense cloud."""
    check_finished(run, [MESH], "dense cloud", "`--points` exports the sparse points")
    file = run.workspace.surface / FUSED
    if not file.exists():
        raise InputError(f"{file} is gone", f"`sfm-app run PHOTOS -o {run.workspace.root} --from mesh` makes it again")
    return file


def stored_cloud(run: RunContext) -> PointCloud:
    """Read the dense cloud."""
    file = check_cloud(run)
    with check_undamaged(MESH, run):
        records = open_points(file)
        points, colors, normals = (
            positions(records),
            np.array(_columns(records, COLORS), np.uint8),
            _columns(records, NORMALS),
        )
    frame = export_frame(run)
    if frame is not None:
        points, normals = frame(points), normals @ frame.R.T
    return PointCloud(points, colors, normals)


def _columns(records: NDArray[np.void], names: Sequence[str]) -> FloatArray:
    return np.stack([records[name] for name in names], axis=1).astype(np.float64)


# A finished run as the input of scene formats.

IMAGES, MASKS = "images", "masks"


class StoredScene:
    """The scene of a finished run, a `FinishedScene`."""

    def __init__(self, run: RunContext, box: FloatArray | None = None) -> None:
        self._run, self._box = run, box
        self.scene, self._model = stored_scene(run)
        self._place = stored_frame(run).place
        self.images = dict[str, str]()
        """Photo by name of its file, of all photos written so far."""

    def points(self) -> PointCloud:
        """Return the sparse points."""
        return all_points(self._model)

    def cloud(self) -> PointCloud:
        """Return the dense cloud, or what is in the box."""
        cloud = stored_cloud(self._run)
        if self._box is None:
            return cloud
        inside = in_box(cloud.points, self._box)
        normals = None if cloud.normals is None else cloud.normals[inside]
        return PointCloud(cloud.points[inside], cloud.colors[inside], normals)

    def cloud_on_map(self) -> tuple[PointCloud, str]:
        """Return the dense cloud, z up in a system, and its WKT; as in `cloud` and empty where the place is unknown."""
        cloud = self.cloud()
        if self._place is None:
            return cloud, ""
        here = MapFrame(self._place)
        return PointCloud(here.positions(cloud.points), cloud.colors), here.wkt

    def perspective(self, *, centered: bool = False) -> "StoredPhotos":
        """Return the undistorted photos; `centered` puts the optical center in the middle."""
        views = StoredPhotos(self.scene, self._model, self._run, centered=centered)
        self.images |= {view.name: view.photo for view in views.photos}
        return views

    def record_entries(self, file_format: str) -> dict[str, object]:
        """Return the entries of a folder's record; photos have the user's paths."""
        place = self._run.workspace
        paths = {photo.name: photo.label for photo in read_photo_list(place).photos} if place.photo_set.exists() else {}
        return {
            "made_by": "sfm_app",
            "format": file_format,
            "photo_of": {image: paths.get(photo, photo) for image, photo in self.images.items()},
            "unregistered": {paths.get(photo, photo): why for photo, why in self.scene.unregistered.items()},
            **map_entry(self._place),
        }

    def say(self, text: str) -> None:
        """Show the user a message."""
        self._run.progress.say(text)


class StoredPhotos:
    """The undistorted photos of a finished run, a `PerspectiveScene`."""

    def __init__(self, scene: Scene, model: Reconstruction, run: RunContext, *, centered: bool) -> None:
        self._model, self._run = model, run
        self._lenses = full_size_lenses(model, centered=centered)
        names = {image.name: image.camera_id for image in model.images.values() if image.name in scene.cam_from_world}
        self._names, self._camera_of = view_names(names, self._lenses), names
        self._maps = PixelMaps(model, self._lenses)

    @cached_property
    def photos(self) -> tuple[PerspectivePhoto, ...]:
        """All photos, by name."""
        views = perspective_photos(self._model, self._lenses, self._names)
        if not self._has_masks:
            return views
        return tuple(replace(view, mask=mask_path(Path(), view.name).name) for view in views)

    @property
    def _mask_dir(self) -> Path | None:
        return self._run.workspace.masks if self._run.workspace.masks.is_dir() else None

    @property
    def _has_masks(self) -> bool:
        """Whether photos have masks: the user's, or of the parts of wide views outside of the photo."""
        return self._mask_dir is not None or any(len(lens.views) > 1 for lens in self._lenses.values())

    def write_photos(self, folder: Path) -> None:
        """Write images/, and masks/ if photos have masks."""
        place = self._run.workspace.photos
        gone = [name for name in self._camera_of if not (place / name).exists()]
        if gone:
            hint = f"{place} links to the photos of the run: put them back to where they were"
            raise InputError(f"the photo {list_names(gone, 1)} is gone", hint=hint)
        write = partial(self._write_photo, folder)
        by_camera = sorted(self._camera_of, key=lambda name: (self._camera_of[name], name))
        with self._run.with_workers(self._run.workers) as run:  # an interrupt ends them
            run.map(write, by_camera, "undistorting photos at full size")

    def _write_photo(self, folder: Path, name: str) -> None:
        camera_id = self._camera_of[name]
        with translate_errors(f"undistorting {name}"):
            maps, place = self._maps.camera_maps(camera_id), self._run.workspace.photos
            views = render_views(name, self._lenses[camera_id], place, self._mask_dir, maps)
            for image, (pixels, mask) in zip(self._names[name], views, strict=True):
                save_picture(folder / IMAGES / image, pixels)
                if self._has_masks:
                    save_mask(folder / MASKS, image, shrink_mask(mask))

    def write_colmap(self, folder: Path, *, text: bool = False) -> None:
        """Write COLMAP's model into a new folder."""
        write_view_model(self._model, self._lenses, self._names, folder, text=text)

    def write_bundle(self, file: Path) -> None:
        """Write Bundler's file; the photos are in images/ beside it."""
        scratch = file.with_name(".model")
        try:
            self.write_colmap(scratch)
            write_bundle(scratch, file.parent / IMAGES, file, self._run.workers, self._run.progress)
        finally:
            shutil.rmtree(scratch, ignore_errors=True)


def view_names(cameras: dict[str, int], lenses: dict[int, WideLens]) -> ViewNames:
    """Return the file names of the views of each photo: plain, without folders, and all different."""
    photos = sorted(cameras)
    counts = [len(lenses[cameras[name]].views) for name in photos]
    stems = [str(PurePosixPath(name).with_suffix("")) for name in photos]
    views = [(stem, number, count) for stem, count in zip(stems, counts, strict=True) for number in range(count)]
    plain = iter(plain_names([f"{stem}_{number + 1}" if count > 1 else stem for stem, number, count in views]))
    return {photo: [f"{next(plain)}.jpg" for _ in range(count)] for photo, count in zip(photos, counts, strict=True)}


# Target folders: written as a whole or not at all, and never over files that no export has written.

ELSEWHERE = "name another place with -o"


@contextmanager
def naming_target(place: Path) -> Iterator[None]:
    """Turn errors of the file system into one that names the target of an export."""
    try:
        yield
    except OSError as err:
        raise InputError(f"cannot write {place}: {err.strerror or err}", hint=ELSEWHERE) from err


@contextmanager
def fill_folder(target: Path, about: Callable[[], Mapping[str, object]]) -> Iterator[Path]:
    """Provide an empty folder that replaces `target` at the end, with a record of `about` and its files."""
    check_replaceable(target)
    with replace_folder(target) as draft:
        yield draft
        with replace_atomically(draft / RECORD) as path:
            path.write_text(json_text({**about(), "files": _list_files(draft)}), encoding="utf-8", newline="\n")
        check_replaceable(target)  # it may have changed


def check_replaceable(target: Path) -> None:
    """Check that a folder, which may be missing, holds only files of an export; InputError if not."""
    if is_link(target) or (target.exists() and not target.is_dir()):
        raise InputError(f"{target} is no folder", hint=ELSEWHERE)
    if not target.exists():
        return
    files = _list_files(target)
    foreign = sorted(set(files) - {*recorded_files(target), RECORD})
    if foreign:
        raise InputError(f"{target} holds files that no export has written, such as {foreign[0]}", hint=ELSEWHERE)


def check_parts(main: Path, parts: Sequence[str]) -> None:
    """Check that the other files of a model are missing, or parts of an earlier export to `main`; InputError if not."""
    present = [path for name in parts if (path := main.with_name(name)).exists()]
    named = b"".join(_beginning(path) for path in (main, *present) if path.is_file())
    foreign = [path.name for path in present if path.name.encode() not in named]
    if foreign:
        raise InputError(f"{foreign[0]} beside {main} is no part of an earlier export", hint=ELSEWHERE)


def _beginning(path: Path) -> bytes:
    with path.open("rb") as file:
        return file.read(10_000_000)


def _list_files(folder: Path) -> list[str]:
    return sorted(path.relative_to(folder).as_posix() for path in folder.rglob("*") if not path.is_dir())
