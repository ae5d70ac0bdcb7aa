"""photos: folder -> PhotoSet."""

import json
import shutil
from collections import Counter
from collections.abc import Mapping
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

from sfm_app.context import RunContext
from sfm_app.errors import InputError
from sfm_app.photos import (
    LOSSY,
    MOST_FRAMES,
    Glance,
    Picture,
    UnreadableError,
    camera_name,
    focal_px,
    gps_position,
    grouped,
    lay_out,
    list_files,
    orientation,
    place_of,
    read_picture,
    small_picture,
    stored_names,
    upright,
    without_copies,
)
from sfm_app.settings import PhotoSettings
from sfm_app.stored import is_below, seal
from sfm_app.types import GpsPosition, Photo, PhotoSet, UnusablePhoto

MEGA = 1_000_000
LINKED = ("JPEG", "MPO", "PNG")
"""Formats that COLMAP reads and writes as they are."""


def read_photos(folder: Path, run: RunContext) -> PhotoSet:
    """Look at every file of the folder and lay the usable photos out for COLMAP.

    Raises:
        InputError: the folder is missing, or fewer than two photos are usable.
    """
    options = run.settings.photos
    names = files_of(folder, run)
    found = run.map(partial(read_photo, folder, options=options), names, "photos")
    glances = [photo for photo in found if isinstance(photo, Glance)]
    unusable = [photo for photo in found if isinstance(photo, UnusablePhoto)]
    photos, copies = without_copies(glances) if not options.keep_all else ([g.photo for g in glances], [])
    unusable = sorted(unusable + copies, key=lambda photo: photo.name)
    if len(photos) < 2:
        raise InputError(
            too_few(folder, len(photos), unusable), hint="two photos of one place are the least; 10 to 50 work best"
        )
    photo_set = PhotoSet(folder, tuple(stored_names(grouped(photos, options.cameras))), tuple(unusable))
    shutil.rmtree(run.workspace.photos, ignore_errors=True)
    run.map(partial(laid_out, folder=folder, target=run.workspace.photos), photo_set.photos, "laying photos out")
    save_photo_set(photo_set, run)
    run.record(usable=len(photos), cameras=len(photo_set.groups), unusable={p.name: p.reason for p in unusable})
    run.record(notes={photo.path: list(photo.notes) for photo in photos if photo.notes})
    run.record(gps=sum(photo.gps is not None for photo in photos))
    return photo_set


def files_of(folder: Path, run: RunContext) -> list[str]:
    """Names of all files that a run has to account for.

    Raises:
        InputError: the folder is missing or unreadable, or the run would write over it.
    """
    run.workspace.keep_apart(folder)
    chosen = run.settings.photos.images
    return list_files(folder, run.workspace.root, Path(chosen) if chosen else None)


def read_photo(folder: Path, name: str, *, options: PhotoSettings) -> Glance | UnusablePhoto:
    """Decode one file to know that it is a whole photo, what camera took it, and what it looks like."""
    place = place_of(folder, name)
    if isinstance(place, str):
        return UnusablePhoto(name, place)
    try:
        return described(name, read_picture(place), options)
    except UnreadableError as err:
        return UnusablePhoto(name, str(err))


def described(name: str, picture: Picture, options: PhotoSettings) -> Glance | UnusablePhoto:
    """What is known about a photo, and what it looks like."""
    image, exif = picture.image, picture.exif
    size = image.size[::-1] if orientation(exif) >= 5 else image.size
    if min(size) < options.min_side_px:
        return UnusablePhoto(name, f"smaller than {options.min_side_px} px")
    width, height = scaled(size, options.max_megapixels * MEGA)
    many = f"its {picture.frames}" if picture.frames <= MOST_FRAMES else f"more than {MOST_FRAMES}"
    notes = [f"the first of {many} pictures"] if picture.frames > 1 else []
    if (width, height) != size:
        notes.append(f"scaled down from {size[0]} x {size[1]} to {width} x {height} pixels")
    eight_bit = image.mode in ("RGB", "L") and "transparency" not in image.info
    photo = Photo(
        name=name,
        width=width,
        height=height,
        group=camera_name(exif),
        exif_focal_px=focal_px(exif, max(width, height)),
        needs_copy=not (image.format in LINKED and eight_bit and orientation(exif) == 1 and (width, height) == size),
        gps=gps_position(exif),
        lossy=image.format in LOSSY,
        notes=tuple(notes),
    )
    return Glance(photo, small_picture(upright(picture)))


def scaled(size: tuple[int, int], most_px: float) -> tuple[int, int]:
    """Width and height of a picture with not more pixels than that."""
    share = min(1.0, (most_px / (size[0] * size[1])) ** 0.5)
    return max(1, int(size[0] * share)), max(1, int(size[1] * share))


def laid_out(photo: Photo, *, folder: Path, target: Path) -> None:
    """Put one photo into the workspace.

    Raises:
        InputError: it has changed since it was looked at.
    """
    try:
        lay_out(photo, folder, target)
    except UnreadableError as err:
        raise InputError(
            f"{photo.path} has changed while it was read: {err}", hint="run again when the folder is as it shall be"
        ) from err


def save_photo_set(photos: PhotoSet, run: RunContext) -> None:
    """Write photos.json, with hashes of the copies."""
    copies = {photo.name: _copy_seal(photo, run) for photo in photos.photos}
    values = {**asdict(photos), "folder": str(photos.folder), "copies": copies}
    with run.workspace.replacing(run.workspace.photo_set) as path:
        path.write_text(json.dumps(values, indent=1) + "\n", encoding="utf-8")


def _copy_seal(photo: Photo, run: RunContext) -> str | None:
    """Hash of the bytes of a copy; None where a link leads to the photo, or where nothing is."""
    place = run.workspace.photos / photo.name
    return seal(run.workspace.photos, photo.name) if place.is_file() and not place.is_symlink() else None


def load_photo_set(folder: Path, run: RunContext) -> PhotoSet:
    """Read photos.json back; what is gone of the photos that were laid out, or was damaged, is laid out again."""
    values = json.loads(run.workspace.photo_set.read_text(encoding="utf-8"))
    photos = tuple(_photo(entry) for entry in values["photos"])
    if not all(is_below(photo.name) for photo in photos):
        raise ValueError(f"{run.workspace.photo_set} names photos outside of their folder")
    for photo in photos:
        place, copy = run.workspace.photos / photo.name, values["copies"].get(photo.name)
        if copy != _copy_seal(photo, run) or not (copy or place.resolve() == place_of(folder, photo.path)):
            laid_out(photo, folder=folder, target=run.workspace.photos)
    return PhotoSet(folder, photos, tuple(UnusablePhoto(**photo) for photo in values["unusable"]))


def _photo(entry: Mapping[str, Any]) -> Photo:
    gps = entry.get("gps")
    return Photo(**{**entry, "gps": GpsPosition(**gps) if gps else None, "notes": tuple(entry.get("notes", ()))})


def too_few(folder: Path, usable: int, unusable: list[UnusablePhoto]) -> str:
    """Why there is nothing to reconstruct, in one line."""
    reasons = Counter("copies of another" if "same picture" in photo.reason else photo.reason for photo in unusable)
    seen = ", ".join(f"{count} {reason}" for reason, count in reasons.most_common())
    number = "no usable photo" if usable == 0 else "only one usable photo"
    return f"{number} in {folder}: " + (seen or ("the folder is empty" if usable == 0 else "nothing else is there"))
