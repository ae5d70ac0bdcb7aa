"""A finished run as formats for scenes see it: `FinishedScene` and `PerspectiveScene` of `formats.exporters`."""

import shutil
from dataclasses import replace
from functools import cached_property, partial
from pathlib import Path, PurePosixPath

from sfm_app.colmap.backend import translate_errors
from sfm_app.colmap.masks import shrink_mask
from sfm_app.colmap.perspective.bundler import write_bundle
from sfm_app.colmap.perspective.view_model import (
    PixelMaps,
    ViewNames,
    all_points,
    full_size_lenses,
    perspective_photos,
    write_view_model,
)
from sfm_app.colmap.types import Reconstruction
from sfm_app.colmap.wide_views import WideLens, render_views, save_picture
from sfm_app.errors import InputError
from sfm_app.exports.stored import stored_cloud, stored_scene
from sfm_app.formats.scenes.names import plain_names
from sfm_app.name_lists import list_names
from sfm_app.photos import mask_path, save_mask
from sfm_app.runtime.context import RunContext
from sfm_app.types import Scene
from sfm_app.types.exported import PerspectivePhoto, PointCloud

IMAGES, MASKS = "images", "masks"


class StoredScene:
    """The scene of a finished run.

    Args:
        run: the finished run.

    Raises:
        InputError: the scene has not been made yet, or its files are missing or damaged.
    """

    def __init__(self, run: RunContext) -> None:
        self._run = run
        self.scene, self._model = stored_scene(run)
        self.images = dict[str, str]()
        """Photo by name of the file that shows it, of all photos written so far."""

    def points(self) -> PointCloud:
        """Return the sparse points."""
        return all_points(self._model)

    def cloud(self) -> PointCloud:
        """Return the dense cloud."""
        return stored_cloud(self._run)

    def perspective(self, *, centered: bool = False) -> "StoredPhotos":
        """Return the undistorted photos.

        Args:
            centered: whether the optical center of every photo is in its middle.
        """
        found = StoredPhotos(self.scene, self._model, self._run, centered=centered)
        self.images |= {photo.image: photo.photo for photo in found.photos}
        return found

    def record_entries(self, file_format: str) -> dict[str, object]:
        """Return what the record of a folder says.

        Args:
            file_format: name of the format.
        """
        return {
            "made_by": "sfm_app",
            "format": file_format,
            "photo_of": self.images,
            "unregistered": dict(self.scene.unregistered),
        }

    def say(self, text: str) -> None:
        """Show the user a message."""
        self._run.progress.say(text)


class StoredPhotos:
    """The undistorted photos of a finished run.

    Args:
        scene: poses.
        model: COLMAP's model of the photos.
        run: has photos and masks.
        centered: whether the optical center of every photo is in its middle.

    Raises:
        InputError: photos are gone.
    """

    def __init__(self, scene: Scene, model: Reconstruction, run: RunContext, *, centered: bool) -> None:
        self._model, self._run = model, run
        self._lenses = full_size_lenses(model, centered=centered)
        names = {image.name: image.camera_id for image in model.images.values() if image.name in scene.cam_from_world}
        self._names, self._camera_of = view_names(names, self._lenses), names
        self._maps = PixelMaps(model, self._lenses)

    @cached_property
    def photos(self) -> tuple[PerspectivePhoto, ...]:
        """All of them, by name of the photo."""
        masked = self._has_masks
        found = perspective_photos(self._model, self._lenses, self._names)
        return tuple(_with_mask(photo) for photo in found) if masked else found

    @property
    def _mask_dir(self) -> Path | None:
        return self._run.workspace.masks if self._run.workspace.masks.is_dir() else None

    @property
    def _has_masks(self) -> bool:
        """Whether photos have masks: the user's, or of what views of a wide lens show beyond the photo."""
        return self._mask_dir is not None or any(len(lens.views) > 1 for lens in self._lenses.values())

    def write_photos(self, folder: Path) -> None:
        """Write images/, and masks/ where photos have masks.

        Args:
            folder: where they go.

        Raises:
            InputError: photos are gone.
        """
        place = self._run.workspace.photos
        gone = [name for name in self._camera_of if not (place / name).exists()]
        if gone:
            hint = f"{place} links to the photos of the run: put them back to where they were"
            raise InputError(f"the photo {list_names(gone, 1)} is gone", hint=hint)
        write = partial(self._write_photo, folder)
        by_camera = sorted(self._camera_of, key=lambda name: (self._camera_of[name], name))
        with self._run.with_workers(self._run.workers) as run:  # none of them writes on after an interrupt
            run.map(write, by_camera, "undistorting photos at full size")

    def _write_photo(self, folder: Path, name: str) -> None:
        camera_id = self._camera_of[name]
        with translate_errors(f"undistorting {name}"):
            maps, place = self._maps.camera_maps(camera_id), self._run.workspace.photos
            views = render_views(name, self._lenses[camera_id], place, self._mask_dir, maps)
            for image, (pixels, shown) in zip(self._names[name], views, strict=True):
                save_picture(folder / IMAGES / image, pixels)
                if self._has_masks:
                    save_mask(folder / MASKS, image, shrink_mask(shown))

    def write_colmap(self, folder: Path, *, text: bool = False) -> None:
        """Write COLMAP's model.

        Args:
            folder: created.
            text: whether as text instead of binary.
        """
        write_view_model(self._model, self._lenses, self._names, folder, text=text)

    def write_bundle(self, file: Path) -> None:
        """Write Bundler's file; the photos lie in images/ beside it."""
        scratch = file.with_name(".model")
        try:
            self.write_colmap(scratch)
            write_bundle(scratch, file.parent / IMAGES, file, self._run.workers, self._run.progress)
        finally:
            shutil.rmtree(scratch, ignore_errors=True)


def view_names(cameras: dict[str, int], lenses: dict[int, WideLens]) -> ViewNames:
    """Return the names of the files of the views of each photo: plain, without folders, and all different.

    Args:
        cameras: id of the camera by name of the photo.
        lenses: views by id of the camera.
    """
    photos = sorted(cameras)
    counts = [len(lenses[cameras[name]].views) for name in photos]
    stems = [str(PurePosixPath(name).with_suffix("")) for name in photos]
    views = [(stem, number, count) for stem, count in zip(stems, counts, strict=True) for number in range(count)]
    plain = iter(plain_names([f"{stem}_{number + 1}" if count > 1 else stem for stem, number, count in views]))
    return {photo: [f"{next(plain)}.jpg" for _ in range(count)] for photo, count in zip(photos, counts, strict=True)}


def _with_mask(photo: PerspectivePhoto) -> PerspectivePhoto:
    """Return the photo with the name of its mask."""
    return replace(photo, mask=mask_path(Path(), photo.image).name)
