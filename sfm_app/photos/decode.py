"""From the bytes of a file to an upright picture of 8 bits, or the reason why there is none."""

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

from sfm_app.photos.exif import EXIF_IFD, GPS_IFD, orientation, printable
from sfm_app.photos.tiff import complaints
from sfm_app.photos.video.video_formats import AVIF_BRANDS, HEAD_BYTES, HEIC_BRANDS, is_video

FORMATS = ("JPEG", "PNG", "TIFF", "WEBP", "BMP")
"""What is always read."""
LOSSY = ("JPEG", "MPO", "WEBP", "HEIF", "AVIF")
"""A copy as JPEG loses next to nothing more."""

LARGE_PX = 50_000_000
LEAST_BYTES_PER_PX = 0.02
"""Large photos have more, however hard they are compressed; an area of one color has less."""
MOST_FRAMES = 100
DAMAGED = "truncated or damaged"
ONE_AT_A_TIME = Lock()


class UnreadableError(Exception):
    """Why a file gives no picture; the message is for people."""


@cache
def formats() -> tuple[str, ...]:
    """Return what can be read here: HEIC needs the extra, AVIF a Pillow that was built with it."""
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
    """With its pixels, as the file has them."""
    exif: Image.Exif
    """Empty where it is damaged: the picture may be fine all the same."""
    frames: int
    """Pictures in the file; they are not counted beyond MOST_FRAMES."""


def read_picture(path: Path) -> DecodedPhoto:
    """Decode a file as a whole.

    Raises:
        UnreadableError: it is no photo, or a damaged one.
    """
    try:
        with Image.open(path, formats=formats()) as image:
            _refuse_bombs(image, path)
            frames = _frames_of(image)
            image.seek(0)
            with complaints() as wrong:
                image.load()
            if wrong:
                raise UnreadableError(DAMAGED)
            return DecodedPhoto(image, _exif_of(image), frames)
    except UnidentifiedImageError:
        raise UnreadableError(_no_photo(path)) from None
    except UnreadableError:
        raise
    except Image.DecompressionBombError:
        raise UnreadableError("too many pixels") from None
    except MemoryError:
        raise UnreadableError("too large for the memory of this machine") from None
    except PermissionError:
        raise UnreadableError("not readable: permission denied") from None
    except Exception:  # whatever a decoder makes of damaged bytes
        raise UnreadableError(DAMAGED) from None


@contextmanager
def room_for(path: Path) -> Iterator[None]:
    """Provide large photos are dealt with one at a time: each takes ten bytes per pixel and more."""
    try:
        with Image.open(path, formats=formats()) as image:
            pixels = image.width * image.height
    except Exception:  # who reads it says so
        pixels = 0
    with ONE_AT_A_TIME if pixels > LARGE_PX / 2 else nullcontext():
        yield


def _refuse_bombs(image: Image.Image, path: Path) -> None:
    """Let Pillow refuse what is larger still."""
    pixels = image.width * image.height
    if pixels > LARGE_PX and path.stat().st_size < LEAST_BYTES_PER_PX * pixels:
        raise UnreadableError("too many pixels for a file of its size")


def _frames_of(image: Image.Image) -> int:
    """Return how many pictures a file holds, or MOST_FRAMES + 1; the others of an MPO are previews."""
    if image.format == "MPO":
        return 1
    if image.format != "TIFF":
        return getattr(image, "n_frames", 1)
    for frame in range(1, MOST_FRAMES + 1):  # a list, of which nobody knows how long it is
        try:
            image.seek(frame)
        except EOFError:
            return frame
    return MOST_FRAMES + 1


def _exif_of(image: Image.Image) -> Image.Exif:
    try:
        exif = image.getexif()
        exif.get_ifd(EXIF_IFD)
        exif.get_ifd(GPS_IFD)
    except Exception:  # as above
        return Image.Exif()
    return exif


def upright(picture: DecodedPhoto) -> Image.Image:
    """Return the picture upright by EXIF, in RGB or gray of 8 bits, what is transparent on white."""
    return turned_upright(_eight_bit(picture.image), orientation(picture.exif))


def turned_upright(image: Image.Image, turned: int) -> Image.Image:
    """Return the image after its EXIF orientation is undone.

    Args:
        image: as the file has it.
        turned: EXIF orientation, 1 to 8; another number turns nothing.
    """
    return image.transpose(ORIENTATIONS[turned]) if turned in ORIENTATIONS else image


def turned_back(upright: Image.Image, turn_deg: int) -> Image.Image:
    """Return what has to be turned clockwise to be upright.

    Args:
        upright: image as people see it.
        turn_deg: degrees clockwise: 0, 90, 180 or 270.
    """
    return upright.transpose(TURNS[turn_deg]) if turn_deg else upright


TURNS = {90: Image.Transpose.ROTATE_90, 180: Image.Transpose.ROTATE_180, 270: Image.Transpose.ROTATE_270}
"""What turns counterclockwise."""

ORIENTATIONS = {
    2: Image.Transpose.FLIP_LEFT_RIGHT,
    3: Image.Transpose.ROTATE_180,
    4: Image.Transpose.FLIP_TOP_BOTTOM,
    5: Image.Transpose.TRANSPOSE,
    6: Image.Transpose.ROTATE_270,
    7: Image.Transpose.TRANSVERSE,
    8: Image.Transpose.ROTATE_90,
}
"""What undoes an EXIF orientation."""


def _eight_bit(image: Image.Image) -> Image.Image:
    if image.mode.startswith("I") or image.mode == "F":
        return Image.fromarray(_levels(np.asarray(image)))
    if image.mode in ("RGBA", "RGBa", "LA", "La", "PA") or "transparency" in image.info:
        white = Image.new("RGBA", image.size, "white")
        return Image.alpha_composite(white, image.convert("RGBA")).convert("RGB")
    return image if image.mode in ("RGB", "L") else image.convert("RGB")


def _levels(deep: NDArray[Any]) -> NDArray[np.uint8]:
    """Return gray of 16 bits, or of what range ever, in 256 levels."""
    values = np.nan_to_num(deep.astype(np.float64))
    low, high = values.min(), values.max()
    if deep.dtype.kind in "iu" and low >= 0 and high <= 65535:
        low, high = 0.0, 65535.0 if high > 255 else 255.0
    return np.asarray(np.clip((values - low) * (255.0 / max(high - low, 1e-12)), 0, 255), np.uint8)


def _no_photo(path: Path) -> str:
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
    return f"a video; run it alone: sfm-app run {printable(path.name)}" if is_video(head) else "not a photo"
