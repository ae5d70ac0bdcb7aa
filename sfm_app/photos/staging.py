"""The photos as COLMAP gets them: links to files that it can read, 8-bit copies of the others, as the sensor lies."""

import os
import shutil
from collections.abc import Iterable, Iterator
from dataclasses import replace
from pathlib import Path, PurePosixPath

from PIL import Image

from sfm_app.hashing import is_below
from sfm_app.photos.decode import UnreadableError, read_picture, room_for, turned_back, upright
from sfm_app.photos.files import place_of
from sfm_app.types import Photo

READ_BY_COLMAP = (".jpg", ".jpeg", ".png")
"""COLMAP chooses by these endings how it writes a photo."""
JPEG_QUALITY = 95


def stored_names(photos: Iterable[Photo]) -> Iterator[Photo]:
    """Yield photos with the names that they go by: COLMAP writes them into databases and lists, a line each.

    A name keeps what can be printed and an ending that COLMAP knows; it stays as it is where it can.
    """
    photos = list(photos)
    taken = {photo.path for photo in photos}
    for photo in photos:
        name = "".join(c if c.isprintable() else "_" for c in photo.path)
        if PurePosixPath(name).suffix.lower() not in READ_BY_COLMAP:
            name += ".jpg" if photo.lossy else ".png"
        while name != photo.path and name in taken:
            name = str(PurePosixPath(name).with_name(f"_{PurePosixPath(name).name}"))
        taken.add(name)
        yield replace(photo, name=name, original=photo.path)


def lay_out(photo: Photo, folder: Path, target: Path) -> None:
    """Put one photo where COLMAP reads it.

    Args:
        photo, folder, target: as it was read; of the photos; folder that gets the link or copy.

    Raises:
        OSError: the target cannot be written.
        UnreadableError: the file has changed since it was looked at.
    """
    place = target / photo.name
    if not (is_below(photo.name) and place.parent.resolve().is_relative_to(target.resolve())):
        raise UnreadableError("its name leads out of the folder")
    place.parent.mkdir(parents=True, exist_ok=True)
    place.unlink(missing_ok=True)  # what is written to a link goes where the link leads
    source = place_of(folder, photo.path)
    if isinstance(source, str):
        raise UnreadableError(source)
    if not photo.needs_copy:
        _link(source, place, relative=folder.parent.resolve() == target.parent.resolve())
        return
    with room_for(source):
        _copy(photo, source, place)


def _copy(photo: Photo, source: Path, place: Path) -> None:
    copy = turned_back(upright(read_picture(source)), photo.turn_deg)
    if copy.size != (photo.width, photo.height):
        copy = copy.resize((photo.width, photo.height), Image.Resampling.LANCZOS)
    if photo.lossy:
        copy.save(place, "JPEG", quality=JPEG_QUALITY)
    else:
        copy.save(place, "PNG", compress_level=1)


def _link(source: Path, place: Path, *, relative: bool) -> None:
    """Link a photo: frames are in the output folder and move with it, the user's photos stay where they are."""
    try:
        place.symlink_to(os.path.relpath(source, place.parent.resolve()) if relative else source)
    except OSError:  # Windows without the right to link, some network drives
        shutil.copyfile(source, place)
