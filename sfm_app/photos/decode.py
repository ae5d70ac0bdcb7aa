"""Decode a file to an upright 8-bit picture, or give the reason why it cannot be decoded."""

import importlib
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from threading import Lock
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image, UnidentifiedImageError, features

from sfm_app.photos.exif import EXIF_IFD, GPS_IFD, orientation, printable_text
from sfm_app.photos.tiff import libtiff_errors
from sfm_app.photos.video.video_formats import AVIF_BRANDS, HEAD_BYTES, HEIC_BRANDS, is_video

FORMATS = ("JPEG", "PNG", "TIFF", "WEBP", "BMP")
"""Formats that every Pillow can read."""
LOSSY = ("JPEG", "MPO", "WEBP", "HEIF", "AVIF")
"""Lossy formats: a copy as JPEG loses almost nothing more."""

LARGE_PX = 50_000_000
LEAST_BYTES_PER_PX = 0.02
"""Real photos have more, even at high compression; decompression bombs of one color have less."""
MOST_FRAMES = 100
DAMAGED = "truncated or damaged"
LARGE_PHOTO_LOCK = Lock()


class UnreadableError(Exception):
    """Why a file gives no picture; the message is for people."""


@cache
def formats() -> tuple[str, ...]:
    """Return the formats that this installation reads: HEIC needs the extra, AVIF a Pillow built with it."""
    found = FORMATS + (("AVIF",) if features.check("avif") else ())
    try:
        importlib.import_module("pillow_heif").register_heif_opener()
    except ImportError:
        return found
    return (*found, "HEIF")


@dataclass(frozen=True, slots=True, eq=False)
class DecodedPhoto:
    """The first picture of a file."""

    image: Image.Image
    """Decoded, in the orientation stored in the file."""
    exif: Image.Exif
    """Empty if the EXIF is damaged; the picture may still be intact."""
    frames: int
    """Number of pictures in the file; for a TIFF, counted up to MOST_FRAMES + 1."""


def read_picture(path: Path) -> DecodedPhoto:
    """Decode a whole file.

    Raises:
        UnreadableError: the file is not a photo, or it is damaged.
    """
    try:
        with Image.open(path, formats=formats()) as image:
            _refuse_bombs(image, path)
            frames = _frame_count(image)
            image.seek(0)
            with libtiff_errors() as wrong:
                image.load()
            if wrong:
                raise UnreadableError(DAMAGED)
            return DecodedPhoto(image, _read_exif(image), frames)
    except UnidentifiedImageError:
        raise UnreadableError(_unreadable_reason(path)) from None
    except UnreadableError:
        raise
    except Image.DecompressionBombError:
        raise UnreadableError("too many pixels") from None
    except MemoryError:
        raise UnreadableError("too large for the memory of this machine") from None
    except PermissionError:
        raise UnreadableError("not readable: permission denied") from None
    except Exception:  # decoders raise anything on damaged bytes
        raise UnreadableError(DAMAGED) from None


@contextmanager
def large_photo_lock(path: Path) -> Iterator[None]:
    """Hold a lock while a large photo is decoded, because each takes ten bytes per pixel or more."""
    try:
        with Image.open(path, formats=formats()) as image:
            pixels = image.width * image.height
    except Exception:  # the reader reports it
        pixels = 0
    with LARGE_PHOTO_LOCK if pixels > LARGE_PX / 2 else nullcontext():
        yield


def _refuse_bombs(image: Image.Image, path: Path) -> None:
    """Refuse decompression bombs that are below Pillow's own limit."""
    pixels = image.width * image.height
    if pixels > LARGE_PX and path.stat().st_size < LEAST_BYTES_PER_PX * pixels:
        raise UnreadableError("too many pixels for a file of its size")


def _frame_count(image: Image.Image) -> int:
    """Return the number of pictures, for a TIFF at most MOST_FRAMES + 1; 1 for an MPO, whose others are previews."""
    if image.format == "MPO":
        return 1
    if image.format != "TIFF":
        return getattr(image, "n_frames", 1)
    for frame in range(1, MOST_FRAMES + 1):  # TIFF stores a linked list without its length
        try:
            image.seek(frame)
        except EOFError:
            return frame
    return MOST_FRAMES + 1


def _read_exif(image: Image.Image) -> Image.Exif:
    try:
        exif = image.getexif()
        exif.get_ifd(EXIF_IFD)
        exif.get_ifd(GPS_IFD)
    except Exception:  # damaged EXIF raises anything
        return Image.Exif()
    return exif


def upright_image(picture: DecodedPhoto) -> Image.Image:
    """Return the picture upright by EXIF, in 8-bit RGB or gray, with transparent pixels on white."""
    return undo_exif_orientation(_to_eight_bit(picture.image), orientation(picture.exif))


def undo_exif_orientation(image: Image.Image, turned: int) -> Image.Image:
    """Turn an image upright by its EXIF orientation.

    Args:
        image: as stored in the file.
        turned: EXIF orientation, 1 to 8; other values leave the image unchanged.
    """
    return image.transpose(ORIENTATIONS[turned]) if turned in ORIENTATIONS else image


def rotate_to_sensor(upright: Image.Image, turn_deg: int) -> Image.Image:
    """Turn an upright image back to the orientation of the sensor.

    Args:
        upright: image as displayed.
        turn_deg: clockwise rotation from sensor to upright, in degrees: 0, 90, 180 or 270.
    """
    return upright.transpose(TURNS[turn_deg]) if turn_deg else upright


TURNS = {90: Image.Transpose.ROTATE_90, 180: Image.Transpose.ROTATE_180, 270: Image.Transpose.ROTATE_270}
"""Pillow's transposition for each counterclockwise rotation, in degrees."""

ORIENTATIONS = {
    2: Image.Transpose.FLIP_LEFT_RIGHT,
    3: Image.Transpose.ROTATE_180,
    4: Image.Transpose.FLIP_TOP_BOTTOM,
    5: Image.Transpose.TRANSPOSE,
    6: Image.Transpose.ROTATE_270,
    7: Image.Transpose.TRANSVERSE,
    8: Image.Transpose.ROTATE_90,
}
"""Pillow's transposition that undoes each EXIF orientation."""


def _to_eight_bit(image: Image.Image) -> Image.Image:
    if image.mode.startswith("I") or image.mode == "F":
        return Image.fromarray(_to_gray_levels(np.asarray(image)))
    if image.mode in ("RGBA", "RGBa", "LA", "La", "PA") or "transparency" in image.info:
        white = Image.new("RGBA", image.size, "white")
        return Image.alpha_composite(white, image.convert("RGBA")).convert("RGB")
    return image if image.mode in ("RGB", "L") else image.convert("RGB")


def _to_gray_levels(deep: NDArray[Any]) -> NDArray[np.uint8]:
    """Map 16-bit gray, or gray of any other range, to 256 levels."""
    values = np.nan_to_num(deep.astype(np.float64))
    low, high = values.min(), values.max()
    if deep.dtype.kind in "iu" and low >= 0 and high <= 65535:
        low, high = 0.0, 65535.0 if high > 255 else 255.0
    return np.asarray(np.clip((values - low) * (255.0 / max(high - low, 1e-12)), 0, 255), np.uint8)


def _unreadable_reason(path: Path) -> str:
    try:
        with path.open("rb") as file:
            head = file.read(HEAD_BYTES)
    except OSError:
        head = b""
    if not head:
        return "empty"
    if head[4:8] == b"ftyp" and head[8:12] in HEIC_BRANDS:
        return DAMAGED if "HEIF" in formats() else "HEIC photos need `pip install 'sfm-app[heic]'`"
    if head[4:8] == b"ftyp" and head[8:12] in AVIF_BRANDS:
        needed = "AVIF photos need a newer Pillow: `pip install -U pillow`"
        return DAMAGED if "AVIF" in formats() else needed
    return f"a video; run it alone: sfm-app run {printable_text(path.name)}" if is_video(head) else "not a photo"
