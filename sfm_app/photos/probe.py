"""Examine one file of the folder: a usable photo, or the reason why it is not one."""

from dataclasses import replace
from pathlib import Path

from PIL import Image

from sfm_app.photos.decode import (
    LOSSY,
    MOST_FRAMES,
    DecodedPhoto,
    UnreadableError,
    large_photo_lock,
    read_picture,
    rotate_to_sensor,
    upright_image,
)
from sfm_app.photos.exif import camera_name, focal_px, gps_position, orientation, turn_deg
from sfm_app.photos.files import resolve_file
from sfm_app.photos.letterbox import shown_part
from sfm_app.photos.panoramas.recognition import is_panorama
from sfm_app.photos.selection.thumbnail_stats import PhotoStats, measure_photo
from sfm_app.settings import PhotoSettings
from sfm_app.types import Frame, Photo, UnusablePhoto
from sfm_app.types.calibration import EQUIRECTANGULAR, PERSPECTIVE

MEGA = 1_000_000
LINKED_FORMATS = ("JPEG", "MPO", "PNG")
"""Formats that COLMAP reads and writes without conversion."""


def read_photo(folder: Path, name: str, *, options: PhotoSettings) -> PhotoStats | UnusablePhoto:
    """Decode one file to check that it is intact, and measure what is needed to compare it with other photos.

    Args:
        folder: of the photos.
        name: path inside the folder.
        options: smallest and largest size.
    """
    place = resolve_file(folder, name)
    if isinstance(place, str):
        return UnusablePhoto(name, place)
    try:
        with large_photo_lock(place):
            return describe(name, read_picture(place), options)
    except UnreadableError as err:
        return UnusablePhoto(name, str(err))


def describe(name: str, picture: DecodedPhoto, options: PhotoSettings) -> PhotoStats | UnusablePhoto:
    """Return a photo's metadata and image statistics.

    Args:
        name: path inside the folder.
        picture: what the file holds.
        options: smallest and largest size.

    Raises:
        UnreadableError: it is a panorama that does not show the whole sphere.
    """
    image, exif = picture.image, picture.exif
    upright = upright_image(picture)
    panorama = is_panorama(picture, upright)
    turn = 0 if panorama else turn_deg(exif)  # rows of a panorama are latitudes
    size = image.size[::-1] if orientation(exif) >= 5 and not turn else image.size
    if min(size) < options.min_side_px:
        return UnusablePhoto(name, f"smaller than {options.min_side_px} px")
    width, height = scaled_size(size, options.max_megapixels * MEGA)
    many = f"its {picture.frames}" if picture.frames <= MOST_FRAMES else f"more than {MOST_FRAMES}"
    notes = [f"the first of {many} pictures"] if picture.frames > 1 else []
    if (width, height) != size:
        notes.append(f"scaled down from {size[0]} x {size[1]} to {width} x {height} pixels")
    if panorama:
        notes.append("a panorama of 360 x 180 degrees")
    eight_bit = image.mode in ("RGB", "L") and "transparency" not in image.info
    photo = Photo(
        name=name,
        width=width,
        height=height,
        group=camera_name(exif),
        exif_focal_px=None if panorama else focal_px(exif, max(width, height)),
        needs_copy=not (
            image.format in LINKED_FORMATS and eight_bit and orientation(exif) == 1 and (width, height) == size
        ),
        gps=gps_position(exif),
        lossy=image.format in LOSSY,
        turn_deg=turn,
        notes=tuple(notes),
        projection=EQUIRECTANGULAR if panorama else PERSPECTIVE,
    )
    return measure_photo(photo if panorama else replace(photo, shown=_shown_frame(upright, photo)), upright)


def _shown_frame(seen: Image.Image, photo: Photo) -> Frame | None:
    """Return the frame of the picture within bars, in pixels of the laid-out photo."""
    laid = rotate_to_sensor(seen, photo.turn_deg)
    found = shown_part(laid)
    if found is None or laid.size == (photo.width, photo.height):
        return found
    x, y = photo.width / laid.width, photo.height / laid.height
    return round(found[0] * x), round(found[1] * y), round(found[2] * x), round(found[3] * y)


def scaled_size(size: tuple[int, int], most_px: float) -> tuple[int, int]:
    """Return width and height after shrinking a picture to at most `most_px` pixels.

    Args:
        size: width and height in pixels.
        most_px: pixels in all, >= 1.
    """
    share = min(1.0, (most_px / (size[0] * size[1])) ** 0.5)
    return max(1, int(size[0] * share)), max(1, int(size[1] * share))
