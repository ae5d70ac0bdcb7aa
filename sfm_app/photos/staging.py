"""Lay photos out for COLMAP: links to files that it can read, 8-bit copies of the others, in sensor orientation."""

import filecmp
import os
from collections.abc import Iterable, Iterator
from dataclasses import replace
from pathlib import Path, PurePosixPath

from PIL import Image

from sfm_app.hashing import is_below
from sfm_app.operating_system import is_link, link_or_copy
from sfm_app.photos.decode import UnreadableError, large_photo_lock, read_picture, rotate_to_sensor, upright_image
from sfm_app.photos.files import resolve_file
from sfm_app.types import Photo

READ_BY_COLMAP = (".jpg", ".jpeg", ".png")
"""File extensions by which COLMAP chooses the format it writes."""
JPEG_QUALITY = 95


def assign_names(photos: Iterable[Photo]) -> Iterator[Photo]:
    """Yield photos with names that COLMAP can write into databases and line-based lists.

    A name is printable and has an extension that COLMAP knows; a name that already fits is kept. Names differ by more
    than capitals, which many file systems do not tell apart.
    """
    photos = list(photos)
    given, taken = {photo.path.casefold() for photo in photos}, set[str]()
    for photo in photos:
        name = "".join(c if c.isprintable() else "_" for c in photo.path)
        if PurePosixPath(name).suffix.lower() not in READ_BY_COLMAP:
            name += ".jpg" if photo.lossy else ".png"
        while name.casefold() in taken or (name != photo.path and name.casefold() in given):
            name = str(PurePosixPath(name).with_name(f"_{PurePosixPath(name).name}"))
        taken.add(name.casefold())
        yield replace(photo, name=name, original=photo.path)


def lay_out(photo: Photo, folder: Path, target: Path) -> None:
    """Link or copy one photo to where COLMAP reads it.

    Args:
        photo, folder, target: as read; folder of the photos; folder to put the link or copy in.

    Raises:
        OSError: the target cannot be written.
        UnreadableError: the file has changed since it was read.
    """
    place = target / photo.name
    if not (is_below(photo.name) and place.parent.resolve().is_relative_to(target.resolve())):
        raise UnreadableError("its name leads out of the folder")
    place.parent.mkdir(parents=True, exist_ok=True)
    place.unlink(missing_ok=True)  # writing to an existing link would change its target
    source = resolve_file(folder, photo.path)
    if isinstance(source, str):
        raise UnreadableError(source)
    if not photo.needs_copy:
        _link(source, place, relative=folder.parent.resolve() == target.parent.resolve())
        return
    with large_photo_lock(source):
        _copy(photo, source, place)


def is_laid_out(photo: Photo, folder: Path, target: Path) -> bool:
    """Return whether the link to a photo, or its unchanged copy, is where COLMAP reads it.

    Args:
        photo, folder, target: as in `lay_out`; a photo that COLMAP can read as it is.
    """
    place, source = target / photo.name, resolve_file(folder, photo.path)
    if isinstance(source, str) or not place.is_file():
        return False
    return place.resolve() == source or (not is_link(place) and filecmp.cmp(source, place, shallow=False))


def _copy(photo: Photo, source: Path, place: Path) -> None:
    copy = rotate_to_sensor(upright_image(read_picture(source)), photo.turn_deg)
    if copy.size != (photo.width, photo.height):
        copy = copy.resize((photo.width, photo.height), Image.Resampling.LANCZOS)
    if photo.lossy:
        copy.save(place, "JPEG", quality=JPEG_QUALITY)
    else:
        copy.save(place, "PNG", compress_level=1)


def _link(source: Path, place: Path, *, relative: bool) -> None:
    """Link a photo, or copy it; a relative link is for video frames, which move together with the output folder."""
    link_or_copy(place, os.path.relpath(source, place.parent.resolve()) if relative else source, source)
