"""photos: folder -> PhotoSet."""

import json
import os
import shutil
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image, ImageOps, UnidentifiedImageError

from sfm_app.context import RunContext
from sfm_app.errors import InputError
from sfm_app.settings import PhotoSettings
from sfm_app.types import GpsPosition, Photo, PhotoSet, UnusablePhoto

FORMATS = ("JPEG", "PNG")
"""What is read so far."""

EXIF_MAKE, EXIF_MODEL, EXIF_ORIENTATION, EXIF_IFD = 0x010F, 0x0110, 0x0112, 0x8769
EXIF_FOCAL_MM, EXIF_FOCAL_35MM = 0x920A, 0xA405
EXIF_GPS_IFD = 0x8825
GPS_LATITUDE_REF, GPS_LATITUDE, GPS_LONGITUDE_REF, GPS_LONGITUDE, GPS_ALTITUDE_REF, GPS_ALTITUDE = range(1, 7)
LOWEST_M, HIGHEST_M = -1000.0, 20_000.0
"""Altitudes that a photo may be taken at."""

FULL_FRAME_WIDTH_MM = 36.0


def read_photos(folder: Path, run: RunContext) -> PhotoSet:
    """Look at every file of the folder and lay the usable photos out for COLMAP.

    Raises:
        InputError: the folder is missing, or fewer than two photos are usable.
    """
    names = list_files(folder, exclude=run.workspace.root)
    found = run.map(partial(read_photo, folder, options=run.settings.photos), names, "photos")
    photos = [photo for photo in found if isinstance(photo, Photo)]
    unusable = tuple(photo for photo in found if isinstance(photo, UnusablePhoto))
    reasons = Counter(photo.reason for photo in unusable)
    if len(photos) < 2:
        raise InputError(
            _too_few(folder, len(photos), reasons), hint="two photos of one place are the least; 10 to 50 work best"
        )
    photo_set = PhotoSet(folder, tuple(_grouped(photos, run.settings.photos.cameras)), unusable)
    lay_out(photo_set, run)
    save_photo_set(photo_set, run)
    run.record(usable=len(photos), cameras=len(photo_set.groups), unusable={p.name: p.reason for p in unusable})
    run.record(gps=sum(photo.gps is not None for photo in photos))
    return photo_set


def list_files(folder: Path, exclude: Path) -> list[str]:
    """Names of all files below the folder, sorted, without hidden ones and without the output folder.

    Raises:
        InputError: there is no such folder, or it cannot be read.
    """
    if not folder.exists():
        raise InputError(f"no such folder: {folder}", hint="name the folder that holds the photos")
    if not folder.is_dir():
        raise InputError(f"not a folder: {folder}", hint="name the folder that holds the photos, not a photo")
    try:
        next(folder.iterdir(), None)
    except OSError as err:
        raise InputError(f"cannot read {folder}: {err.strerror}") from err
    return sorted(path.relative_to(folder).as_posix() for path in _walk(folder, exclude.resolve()))


def read_photo(folder: Path, name: str, *, options: PhotoSettings) -> Photo | UnusablePhoto:
    """Decode one file as far as needed to know that it is a whole photo, and what camera took it."""
    try:
        with Image.open(folder / name, formats=FORMATS) as image:
            image.load()
            return _described(name, image, options)
    except UnidentifiedImageError:
        return UnusablePhoto(name, "not a JPEG or PNG photo")
    except Image.DecompressionBombError:
        return UnusablePhoto(name, "too many pixels")
    except (OSError, SyntaxError, ValueError) as err:
        reason = "truncated or damaged" if not isinstance(err, PermissionError) else "not readable: permission denied"
        return UnusablePhoto(name, reason)


def lay_out(photos: PhotoSet, run: RunContext) -> None:
    """Fill the workspace's photo folder: links to what COLMAP can read, upright 8-bit copies of the rest."""
    target = run.workspace.photos
    shutil.rmtree(target, ignore_errors=True)
    for photo in photos.photos:
        place = target / photo.name
        place.parent.mkdir(parents=True, exist_ok=True)
        if photo.needs_copy:
            with Image.open(photos.folder / photo.name) as image:
                save_options = {"quality": 95} if image.format == "JPEG" else {}
                _eight_bit(ImageOps.exif_transpose(image)).save(place, image.format, **save_options)
        else:
            _link(photos.folder / photo.name, place)


def save_photo_set(photos: PhotoSet, run: RunContext) -> None:
    """Write photos.json."""
    with run.workspace.replacing(run.workspace.photo_set) as path:
        path.write_text(json.dumps({**asdict(photos), "folder": str(photos.folder)}, indent=1) + "\n", encoding="utf-8")


def load_photo_set(run: RunContext) -> PhotoSet:
    """Read photos.json back."""
    values = json.loads(run.workspace.photo_set.read_text(encoding="utf-8"))
    photos = tuple(_photo(entry) for entry in values["photos"])
    return PhotoSet(Path(values["folder"]), photos, tuple(UnusablePhoto(**photo) for photo in values["unusable"]))


def _photo(entry: Mapping[str, Any]) -> Photo:
    gps = entry.get("gps")
    return Photo(**{**entry, "gps": GpsPosition(**gps) if gps else None})


def _walk(folder: Path, exclude: Path) -> Iterator[Path]:
    for place, folders, files in os.walk(folder):
        folders[:] = [n for n in folders if not n.startswith(".") and (Path(place) / n).resolve() != exclude]
        yield from (Path(place) / name for name in files if not name.startswith("."))


def _described(name: str, image: Image.Image, options: PhotoSettings) -> Photo | UnusablePhoto:
    exif = image.getexif()
    turned = exif.get(EXIF_ORIENTATION, 1) in (5, 6, 7, 8)
    width, height = image.size[::-1] if turned else image.size
    if min(width, height) < options.min_side_px:
        return UnusablePhoto(name, f"smaller than {options.min_side_px} px")
    details = exif.get_ifd(EXIF_IFD)
    camera = [str(exif.get(tag, "")).strip("\0 ") for tag in (EXIF_MAKE, EXIF_MODEL)] + [
        str(details.get(EXIF_FOCAL_MM, ""))
    ]
    return Photo(
        name=name,
        width=width,
        height=height,
        group=" ".join([f"{width}x{height}", *filter(None, camera)]),
        exif_focal_px=_exif_focal_px(details.get(EXIF_FOCAL_35MM), max(width, height)),
        needs_copy=exif.get(EXIF_ORIENTATION, 1) not in (0, 1) or image.mode not in ("RGB", "L"),
        gps=gps_position(exif.get_ifd(EXIF_GPS_IFD)),
    )


def gps_position(entries: Mapping[int, Any]) -> GpsPosition | None:
    """The position in EXIF's table of GPS entries; None where it is missing or cannot be true.

    Cameras without a fix write zeros: latitude and longitude 0 is open sea, and counts as missing.
    """
    latitude = _degrees(entries.get(GPS_LATITUDE), entries.get(GPS_LATITUDE_REF), "NS", 90.0)
    longitude = _degrees(entries.get(GPS_LONGITUDE), entries.get(GPS_LONGITUDE_REF), "EW", 180.0)
    if latitude is None or longitude is None or latitude == longitude == 0.0:
        return None
    return GpsPosition(latitude, longitude, _altitude_m(entries.get(GPS_ALTITUDE), entries.get(GPS_ALTITUDE_REF)))


def _degrees(parts: Any, reference: Any, sides: str, largest: float) -> float | None:
    """Signed degrees from EXIF's degrees, minutes and seconds and the letter of the side."""
    try:
        degrees, minutes, seconds = (float(part) for part in parts)
        side = sides.index(str(reference).strip("\0 ").upper()[:1] or "?")
    except (TypeError, ValueError, ZeroDivisionError):
        return None
    if not (degrees >= 0 and 0 <= minutes <= 60 and 0 <= seconds <= 60):
        return None
    value = degrees + minutes / 60 + seconds / 3600
    return (-value if side else value) if value <= largest else None


def _altitude_m(altitude: Any, reference: Any) -> float | None:
    try:
        value = float(altitude)
    except (TypeError, ValueError, ZeroDivisionError):
        return None
    below = reference in (1, b"\x01")
    value = -value if below else value
    return value if LOWEST_M <= value <= HIGHEST_M else None


def _exif_focal_px(focal_35mm: object, longer_side: int) -> float | None:
    try:
        focal = float(focal_35mm) * longer_side / FULL_FRAME_WIDTH_MM  # type: ignore[arg-type]
    except (TypeError, ValueError, ZeroDivisionError):
        return None
    return focal if 0.1 * longer_side < focal < 50 * longer_side else None


def _grouped(photos: list[Photo], cameras: str) -> Iterator[Photo]:
    for photo in photos:
        size = f"{photo.width}x{photo.height}"  # COLMAP's cameras have one size: even `single` keeps sizes apart
        yield replace(photo, group={"auto": photo.group, "single": size, "each": f"{size} {photo.name}"}[cameras])


def _too_few(folder: Path, usable: int, reasons: Counter[str]) -> str:
    seen = ", ".join(f"{count} {reason}" for reason, count in reasons.most_common())
    number = "no usable photo" if usable == 0 else "only one usable photo"
    return f"{number} in {folder}: " + (seen or ("the folder is empty" if usable == 0 else "nothing else is there"))


def _eight_bit(image: Image.Image) -> Image.Image:
    if image.mode.startswith("I"):  # 16 bit per pixel
        return Image.fromarray((np.asarray(image).astype(np.uint32) >> 8).clip(0, 255).astype(np.uint8))
    if image.mode in ("RGBA", "LA", "PA") or "transparency" in image.info:
        white = Image.new("RGBA", image.size, "white")
        return Image.alpha_composite(white, image.convert("RGBA")).convert("RGB")
    return image if image.mode in ("RGB", "L") else image.convert("RGB")


def _link(source: Path, place: Path) -> None:
    try:
        place.symlink_to(source.resolve())
    except OSError:  # Windows without the right to link, some network drives
        shutil.copyfile(source, place)
