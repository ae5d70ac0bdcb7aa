"""Decode a file to an upright 8-bit picture, or give the reason why it cannot be decoded."""

import ctypes
import importlib
import logging
import re
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, field, replace
from functools import cache, lru_cache
from io import BytesIO
from pathlib import Path
from threading import Lock
from types import MappingProxyType
from typing import Any, BinaryIO, Literal

import cv2
import numpy as np
import PIL
from numpy.typing import NDArray
from PIL import Image, ImageCms, UnidentifiedImageError, features
from PIL.ExifTags import GPS, IFD, Base
from PIL.TiffImagePlugin import COMPRESSION_INFO, IMAGELENGTH, IMAGEWIDTH, ImageFileDirectory_v2

from sfm_app.operating_system import find_in_wheel
from sfm_app.photos.files import AVIF_BRANDS, HEAD_BYTES, HEIC_BRANDS, is_video
from sfm_app.types import CameraPrior, GpsPosition
from sfm_app.types.arrays import BoolArray, ByteArray
from sfm_app.types.photos import EXIF, SEA_LEVEL, TAKE_OFF

logger = logging.getLogger("sfm_app")

FORMATS = ("JPEG", "PNG", "TIFF", "WEBP", "BMP", "GIF", "PPM", "PSD", "SGI", "PCX", "QOI", "TGA")
"""Formats that every Pillow can read; the last one, without a mark of its own, is tried last."""
WITH_LIBRARY = {"AVIF": "avif", "JPEG2000": "jpg_2000"}
"""Formats that Pillow reads with a library, by the name of its feature."""
UNREAD = {
    "a JPEG XL photo": (b"\xff\x0a", b"\0\0\0\x0cJXL "),
    "a JPEG XR photo": (b"II\xbc",),
    "an OpenEXR picture": (b"\x76\x2f\x31\x01",),
    "a Radiance HDR picture": (b"#?RADIANCE", b"#?RGBE"),
    "a floating-point picture in PFM": (b"PF\n",),
    "a texture in DDS": (b"DDS ",),
}
"""First bytes of pictures that Pillow cannot read."""
ICONS = (b"\0\0\1\0", b"\0\0\2\0\1", b"icns")
SAVE_IT = "save it as JPEG or PNG"
LOSSY = ("JPEG", "MPO", "WEBP", "HEIF", "AVIF")
"""Lossy formats: a copy as JPEG loses almost nothing more."""
TIFF_HEADS = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")
RAW_HEADS = (b"FUJIFILMCCD-RAW", b"IIRO", b"IIRS", b"MMOR", b"IIU\0", b"FOVb", b"\0MRM", b"II\x1a\0\0\0HEAP")
"""First bytes of raw photos that are no TIFF: Fujifilm, Olympus, Panasonic, Sigma, Minolta and old Canon."""
RAW_COLORS = (32803, 34892)
"""TIFF's colors of sensors: a filter array, and what is made of it before it is developed."""
RAW_TURNS = {3: 3, 5: 8, 6: 6}
"""EXIF's orientation by LibRaw's."""
NEW_SUBFILE_TYPE = 254
LARGE_PX = 50_000_000
MOST_FRAMES = 100
DAMAGED = "truncated or damaged"
LARGE_PHOTO_LOCK = Lock()
EXIF_DEVIATION = 0.04
"""Standard deviation of EXIF's focal, as a share of it: millimeters and sensor sizes are rounded; by hand."""
SENSOR_UNITS_MM = {2: 25.4, 3: 10.0, 4: 1.0, 5: 0.001}
"""Length of EXIF's units of the sensor's resolution; 2, the inch, is the default. By definition."""


def orientation(exif: Image.Exif) -> int:
    """Return the EXIF orientation, 1 to 8; 1 (upright) if it is missing or invalid."""
    value = exif.get(Base.Orientation, 1)
    return value if isinstance(value, int) and 1 <= value <= 8 else 1


def turn_deg(exif: Image.Exif) -> int:
    """Return the clockwise rotation from sensor to upright, in degrees; 0 also for mirrored pictures."""
    return {3: 180, 6: 90, 8: 270}.get(orientation(exif), 0)


def camera_name(exif: Image.Exif) -> str:
    """Return make, model, focal length and digital zoom in one text; empty without them."""
    details = exif.get_ifd(IFD.Exif)
    parts = [
        exif.get(Base.Make),
        exif.get(Base.Model),
        details.get(Base.FocalLength),
        _zoom(details.get(Base.DigitalZoomRatio)),
    ]
    return " ".join(text for text in (printable_text(value) for value in parts) if text)


def exif_prior(exif: Image.Exif, longer_side: int) -> CameraPrior | None:
    """Return EXIF's claim of a focal, by the 35 mm equivalent or else the sensor; None if it is implausible."""
    details = exif.get_ifd(IFD.Exif)
    for claim in (_equivalent_focal, _sensor_focal):
        try:
            focal = longer_side * claim(details)
        except (KeyError, TypeError, ValueError, ZeroDivisionError, OverflowError):
            continue
        if 0.1 * longer_side < focal < 50 * longer_side:
            return CameraPrior(EXIF, focal, EXIF_DEVIATION * focal)
    return None


def _equivalent_focal(details: Mapping[int, Any]) -> float:
    return float(details.get(Base.FocalLengthIn35mmFilm, 0.0)) / 36.0  # the width of full frame, mm


def _sensor_focal(details: Mapping[int, Any]) -> float:
    """Return the focal length in longer sides of the photo as taken, before it was scaled."""
    unit_mm = SENSOR_UNITS_MM[int(details.get(Base.FocalPlaneResolutionUnit, 2))]
    longer_px = max(float(details[Base.ExifImageWidth]), float(details[Base.ExifImageHeight]))
    return float(details[Base.FocalLength]) * float(details[Base.FocalPlaneXResolution]) / unit_mm / longer_px


def gps_position(exif: Image.Exif, xmp: Mapping[str, str] = MappingProxyType({})) -> GpsPosition | None:
    """Return the position by EXIF, else by XMP; None if implausible, or 0, 0, which cameras without a fix write."""
    entries: Mapping[int, Any] = exif.get_ifd(IFD.GPSInfo)
    drone = {name.partition(":")[2].lower(): text for name, text in xmp.items() if name.startswith(DRONES)}
    latitude = _degrees(entries.get(GPS.GPSLatitude), entries.get(GPS.GPSLatitudeRef), "NS", 90.0)
    longitude = _degrees(entries.get(GPS.GPSLongitude), entries.get(GPS.GPSLongitudeRef), "EW", 180.0)
    if latitude is None or longitude is None:
        latitude = _xmp_degrees(drone.get("gpslatitude", ""), "NS", 90.0)
        east = drone.get("gpslongitude") or drone.get("gpslongtitude", "")  # DJI misspelt it
        longitude = _xmp_degrees(east, "EW", 180.0)
    if latitude is None or longitude is None or latitude == longitude == 0.0:
        return None
    altitude, zero = _find_altitude(entries, drone)
    deviation = _largest(drone, "rtkstdlat", "rtkstdlon", "gpsxyaccuracy")
    return GpsPosition(latitude, longitude, altitude, zero, deviation, _largest(drone, "rtkstdhgt", "gpszaccuracy"))


def _find_altitude(entries: Mapping[int, Any], drone: Mapping[str, str]) -> tuple[float | None, str]:
    """Return the altitude by EXIF's and XMP's entries, and what it counts from: the take-off if no other is known."""
    claims = (
        (_number(drone.get("absolutealtitude", "")), 0, SEA_LEVEL),
        (entries.get(GPS.GPSAltitude), entries.get(GPS.GPSAltitudeRef), SEA_LEVEL),
        (_number(drone.get("gpsaltitude", "")), int(drone.get("gpsaltituderef") == "1"), SEA_LEVEL),
        (_number(drone.get("relativealtitude", "")), 0, TAKE_OFF),
    )
    known = ((_altitude_m(value, reference), zero) for value, reference, zero in claims)
    return next((one for one in known if one[0] is not None), (None, SEA_LEVEL))


DRONES = ("drone-dji:", "drone-parrot:", "Camera:", "sensefly:", "exif:")
"""Prefixes of positions in XMP: DJI, Parrot, Pix4D for senseFly, Parrot and MicaSense, and EXIF's own names."""
XMP_DEGREES = re.compile(
    r"([+-]?\d{1,3}(?:\.\d+)?)(?:,(\d{1,2}(?:\.\d+)?))?(?:,(\d{1,2}(?:\.\d+)?))? ?([NSEW]?)", re.ASCII
)
"""Degrees with a sign, or degrees, minutes and perhaps seconds with the letter of the hemisphere."""
XMP_ENTRY = re.compile(
    rb"""<([\w-]{1,40}:\w{1,60})\s{0,9}>([^<]{0,200})</|([\w-]{1,40}:\w{1,60})\s{0,9}=\s{0,9}["']([^"'<]{0,200})["']"""
)
"""An entry of XMP, as an element or as an attribute; lengths are bounded, since files may be damaged or hostile."""
MOST_XMP_BYTES = 262_144
"""Bytes of XMP that are searched, four times what one segment of a JPEG holds. By hand."""


def xmp_entries(image: Image.Image, exif: Image.Exif | None = None) -> dict[str, str]:
    """Return the texts of a decoded picture's XMP, or that of its EXIF, by prefix and name; empty without."""
    keys = ("xmp", "XML:com.adobe.xmp")  # older versions of Pillow call that of PNG so
    xmp = next((image.info[key] for key in keys if image.info.get(key)), None) or (
        exif.get(Base.XMLPacket) if exif else None
    )
    data = xmp.encode() if isinstance(xmp, str) else xmp if isinstance(xmp, bytes) else b""
    entries = ((a or c, b or d) for a, b, c, d in XMP_ENTRY.findall(data[:MOST_XMP_BYTES]))
    return {name.decode(): value.decode(errors="replace").strip() for name, value in entries}


def _xmp_degrees(text: str, sides: str, largest: float) -> float | None:
    """Return signed degrees of XMP."""
    match = XMP_DEGREES.fullmatch(text)
    if not match or match[4] not in ("", *sides):
        return None
    size = sum(abs(float(part)) * 60.0**-k for k, part in enumerate(match.groups()[:3]) if part)
    sign = -1.0 if text.startswith("-") or match[4] == sides[1] else 1.0
    return sign * size if size <= largest else None


def _number(text: str) -> float | None:
    """Return a finite number or fraction of XMP; None for other texts."""
    try:
        above, _, below = text.partition("/")
        value = float(above) / float(below or 1)
    except (ValueError, ZeroDivisionError):
        return None
    return value if np.isfinite(value) else None


def _largest(drone: Mapping[str, str], *names: str) -> float | None:
    """Return the largest deviation in meters that XMP names; None without one above zero."""
    known = (_number(drone.get(name, "")) for name in names)
    return max((one for one in known if one is not None and 0.0 < one < 1e4), default=None)


def printable_text(value: object) -> str:
    """Return a value as text without control characters; empty for None."""
    text = "" if value is None else str(value)
    return " ".join("".join(c if c.isprintable() else " " for c in text).split())


def _zoom(value: Any) -> str | None:
    """Return the digital zoom, which crops like another camera; None for 0 and 1, no zoom."""
    try:
        return None if float(value) in (0.0, 1.0) else f"x{float(value):g}"
    except (TypeError, ValueError, ZeroDivisionError):
        return None


def _degrees(parts: Any, reference: Any, sides: str, largest: float) -> float | None:
    """Return signed degrees from EXIF's degrees, minutes, seconds and hemisphere letter."""
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
    return value if -1000.0 <= value <= 20_000.0 else None


# libtiff prints its errors and returns a damaged picture; Pillow does not check them.

HANDLER = ctypes.CFUNCTYPE(None, ctypes.c_char_p, ctypes.c_char_p, ctypes.c_void_p)
"""Type of libtiff's error callback: module, format and arguments of a message."""

_thread_errors = threading.local()


@contextmanager
def libtiff_errors() -> Iterator[list[str]]:
    """Collect libtiff's errors while this thread decodes; none if Pillow links it statically, as on Windows."""
    _install_handler()
    _thread_errors.errors = []
    try:
        yield _thread_errors.errors
    finally:
        del _thread_errors.errors


def _record_error(_module: Any, text: bytes | None, _arguments: Any) -> None:
    getattr(_thread_errors, "errors", []).append((text or b"").decode(errors="replace"))


ERROR_CALLBACK = HANDLER(_record_error)
"""Kept here, because libtiff keeps only its address."""


@cache
def _install_handler() -> None:
    for library in find_in_wheel(Path(PIL.__file__).parent, "pillow", "libtiff"):
        set_handler = library.TIFFSetErrorHandler
        set_handler.argtypes, set_handler.restype = [HANDLER], ctypes.c_void_p
        set_handler(ERROR_CALLBACK)


# libjpeg only warns of damaged data, which Pillow does not pass on: zeros or the data of another file are decoded to
# the size of the photo, too. But then the data of a scan end before its last block, or go on after it.

SPARE_BYTES = 64
"""Bytes that cameras may add after the last row; damage nearly always leaves more, or fewer than the rows need."""
LOOK_AHEAD = b"\xff\0" * 8
"""The decoder reads so far ahead. The marker of the end would make it fill missing rows; ones are no code."""
NEXT_MARKER = re.compile(rb"\xff+[^\x00\xd0-\xd7\xff]")
"""End of the data of a scan: a marker that is neither a zero, which hides a byte of data, nor one of restarts."""


@dataclass(slots=True)
class _Jpeg:
    """Head with size and colors and its marker, units between two markers (0 without), and scans.

    A scan has its colors, and where its data begin and end.
    """

    frame: bytes = b""
    coding: int = 0
    interval: int = 0
    scans: list[tuple[bytes, int, int]] = field(default_factory=list)


def _parse_jpeg(data: bytes) -> _Jpeg:
    jpeg, at = _Jpeg(), 0
    while (found := NEXT_MARKER.search(data, at)) and (marker := data[found.end() - 1]) != 0xD9:
        at = found.end()
        if marker == 0xD8:  # the start, which has no length
            continue
        at, start = at + int.from_bytes(data[at : at + 2], "big"), at + 2
        if 0xC0 <= marker <= 0xCF and marker not in (0xC4, 0xC8, 0xCC) and not jpeg.frame:  # no tables
            jpeg.frame, jpeg.coding = data[start:at], marker
        elif marker == 0xDD:
            jpeg.interval = int.from_bytes(data[start:at], "big")
        elif marker == 0xDA:
            end = NEXT_MARKER.search(data, at)
            stop = end.start() if end else len(data)
            jpeg.scans.append((data[start + 1 : start + 1 + 2 * data[start] : 2], at, stop))
            at = stop
    return jpeg


def is_whole_jpeg(data: bytes) -> bool:
    """Return whether the data of each scan of a JPEG end with its last block."""
    jpeg = _parse_jpeg(data)
    if jpeg.coding not in (0xC0, 0xC1, 0xC2):
        return jpeg.coding in (0, 0xC3)  # nothing shows the damage of others
    is_enough = _ends_scan if jpeg.coding == 0xC2 or len(jpeg.scans) > 1 else lambda part: not _decoding_error(part)
    return all(_is_whole_scan(data, jpeg, scan, is_enough) for scan in jpeg.scans)


def _is_whole_scan(data: bytes, jpeg: _Jpeg, scan: tuple[bytes, int, int], is_enough: Callable[[bytes], bool]) -> bool:
    colors, at, stop = scan
    if jpeg.interval:
        found = re.findall(rb"\xff([\xd0-\xd7])", data[at:stop])
        expected = (_count_units(jpeg.frame, colors) - 1) // jpeg.interval
        return found == [bytes([0xD0 + number % 8]) for number in range(expected)]
    if not is_enough(data[:stop] + LOOK_AHEAD):
        return False
    return stop - at <= 4 * SPARE_BYTES or not is_enough(data[: stop - SPARE_BYTES])


def _count_units(frame: bytes, colors: bytes) -> int:
    """Return the number of units of a scan: squares of 8 pixels, or several where some of its colors are coarser."""
    height, width = int.from_bytes(frame[1:3], "big"), int.from_bytes(frame[3:5], "big")
    factors = {frame[6 + 3 * k]: (frame[7 + 3 * k] >> 4, frame[7 + 3 * k] & 15) for k in range(frame[5])}
    own = factors[colors[0]] if len(colors) == 1 else (1, 1)
    across, down = 8 * max(h for h, _ in factors.values()), 8 * max(v for _, v in factors.values())
    return -(-width * own[0] // across) * -(-height * own[1] // down)


def _ends_scan(data: bytes) -> bool:
    """Return whether the decoder is done with the last of several scans: it then skips all bytes, for a marker."""
    return all("(0 bytes" in _decoding_error(data + bytes(more)) for more in (0, 1))


def _decoding_error(data: bytes) -> str:
    """Return what Pillow says of a JPEG that breaks off, with the number of bytes that wait for more; else nothing."""
    try:
        with Image.open(BytesIO(data), formats=("JPEG",)) as image:
            image.draft("L", (1, 1))  # the smallest that the decoder makes, for speed
            image.load()
    except OSError as err:
        return str(err)
    return ""


class UnreadableError(Exception):
    """A file gives no picture; the message, for people, says why."""


@cache
def formats() -> tuple[str, ...]:
    """Return the readable formats: HEIC needs the extra, AVIF a Pillow built with it."""
    plain = (*(name for name, library in WITH_LIBRARY.items() if features.check(library)), *FORMATS)
    try:
        importlib.import_module("pillow_heif").register_heif_opener()
    except ImportError:
        return plain
    return (*plain, "HEIF")


@dataclass(frozen=True, slots=True, eq=False)
class DecodedPhoto:
    """The largest picture of a file, the first of several."""

    image: Image.Image
    """Decoded, in the orientation stored in the file."""
    exif: Image.Exif
    """Empty if the EXIF is damaged; the picture may still be intact."""
    frames: int
    """Number of pictures in the file, without previews; for a TIFF, at most MOST_FRAMES + 1."""
    recolored: bool = False
    """True where a color profile was applied, so that the colors are no longer those of the file."""
    notes: tuple[str, ...] = ()
    """Remarks for the user about its colors."""


def read_picture(path: Path) -> DecodedPhoto:
    """Decode a whole file; raise UnreadableError if it is damaged or no photo."""
    try:
        source, frames = _find_picture(path)
        if source is None:
            return _develop(path)
        with Image.open(source, formats=formats()) as image:
            pixels = image.width * image.height
            if pixels > LARGE_PX and path.stat().st_size < 0.02 * pixels:  # real photos have more bytes per pixel
                raise UnreadableError("too many pixels for a file of its size")
            exif = _tiff_exif(path, image) if isinstance(source, BytesIO) else None
            with libtiff_errors() as errors:
                image.load()
            if errors or (image.format in ("JPEG", "MPO") and not is_whole_jpeg(path.read_bytes())):
                raise UnreadableError(_unusual_coding(path) or DAMAGED)
            frames = frames or (1 if image.format == "MPO" else getattr(image, "n_frames", 1))  # MPO adds previews
            return apply_profile(DecodedPhoto(image, exif or _read_exif(image.getexif), frames))
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
        raise UnreadableError(_unusual_coding(path) or DAMAGED) from None


@contextmanager
def large_photo_lock(path: Path) -> Iterator[None]:
    """Hold a lock while a large photo is decoded, which takes at least ten bytes per pixel."""
    try:
        with Image.open(path, formats=formats()) as image:
            pixels = image.width * image.height
    except Exception:  # the reader reports it
        pixels = 0
    with LARGE_PHOTO_LOCK if pixels > LARGE_PX / 2 else nullcontext():
        yield


# Several pictures in one file: a TIFF may begin with a preview, as raw photos do, which are TIFF files, too.


def _find_picture(path: Path) -> tuple[Path | BytesIO | None, int]:
    """Return what holds the largest picture as its first one, and the number of pictures; 0 if Pillow counts them.

    None stands for a raw photo.
    """
    with path.open("rb") as file:
        head = file.read(HEAD_BYTES)
        if is_video(head):
            raise UnreadableError(f"a video; run it alone: sfm-app run {printable_text(path.name)}")
        if head.startswith(RAW_HEADS) or head[4:12] == b"ftypcrx ":
            return None, 1
        if head[:4] not in TIFF_HEADS:
            return path, 0
        if head[8:10] == b"CR":  # Canon
            return None, 1
        start, length = (8, 8) if head[2:4] in (b"+\0", b"\0+") else (4, 4)  # BigTIFF has long addresses
        pictures = _list_tiff(file, head[: start + length])
        if any(tags.get(Base.PhotometricInterpretation) in RAW_COLORS for tags in pictures.values()):
            return None, 1
        whole = [place for place, tags in pictures.items() if not _is_preview(tags)] or [*pictures]
        sizes = [pictures[place].get(IMAGEWIDTH, 0) * pictures[place].get(IMAGELENGTH, 0) for place in whole]
        chosen = whole[sizes.index(max(sizes))]
        if chosen == next(iter(pictures)):
            return path, len(whole)
        file.seek(0)
        data = bytearray(file.read())
    order: Literal["little", "big"] = "little" if head[:2] == b"II" else "big"
    data[start : start + length] = chosen.to_bytes(length, order)  # the place of the first picture
    return BytesIO(data), len(whole)


def _list_tiff(file: BinaryIO, head: bytes) -> dict[int, ImageFileDirectory_v2]:
    """Return the tags of each picture of a TIFF by its place, the first one first; at most MOST_FRAMES + 1."""
    first = ImageFileDirectory_v2(head)
    waiting, found = [first.next], dict[int, ImageFileDirectory_v2]()
    while waiting and len(found) <= MOST_FRAMES:
        place = waiting.pop(0)
        if place and place not in found:
            file.seek(place)
            tags = ImageFileDirectory_v2(head)
            tags.load(file)
            found[place] = tags
            inner = tags.get(Base.SubIFDs, ())
            waiting += [tags.next, *(inner if isinstance(inner, tuple) else (inner,))]
    return found


def _is_preview(tags: ImageFileDirectory_v2) -> bool:
    """Return whether a TIFF calls a picture a reduced one or a mask, by the new tag or the old one."""
    return bool(tags.get(NEW_SUBFILE_TYPE, 0) & 5) or tags.get(Base.SubfileType) == 2


def _develop(path: Path) -> DecodedPhoto:
    """Develop a raw photo with its own white balance; UnreadableError where rawpy is not installed."""
    try:
        rawpy = importlib.import_module("rawpy")
    except ImportError:
        raise UnreadableError("a raw photo: develop it to JPEG or TIFF, or pip install 'sfm-app[raw]'") from None
    with rawpy.imread(str(path)) as raw:
        turn = RAW_TURNS.get(raw.sizes.flip, 1)
        pixels = raw.postprocess(use_camera_wb=True, user_flip=0)
    exif = _tiff_exif(path)
    exif[Base.Orientation] = turn
    return DecodedPhoto(Image.fromarray(pixels), exif, 1)


def _tiff_exif(path: Path, inner: Image.Image | None = None) -> Image.Exif:
    """Return the EXIF of a TIFF, for all its pictures; Pillow turns an inner one by its own orientation."""
    with path.open("rb") as file:

        def load() -> Image.Exif:
            exif = Image.Exif()
            exif.load_from_fp(file)
            return exif

        exif = _read_exif(load)
    if inner is not None and Base.Orientation in inner.getexif():
        exif[Base.Orientation] = 1
    return exif


def _read_exif(load: Callable[[], Image.Exif]) -> Image.Exif:
    try:
        exif = load()
        exif.get_ifd(IFD.Exif)
        exif.get_ifd(IFD.GPSInfo)
    except Exception:  # damaged EXIF raises anything
        return Image.Exif()
    return exif


# Colors: numbers mean colors by the profile of the file; all later steps, and COLMAP, take them as sRGB.

SAME_LEVELS = 2
"""Levels by which colors of an sRGB profile may change in sRGB: several makers rounded it."""


IGNORED = "its color profile is damaged or of another kind, and ignored"


def apply_profile(picture: DecodedPhoto) -> DecodedPhoto:
    """Return the picture in sRGB by its color profile; unchanged without one, and with one that is sRGB or damaged."""
    image = picture.image
    data = image.info.get("icc_profile") or b""
    if not data and image.mode != "LAB":
        return picture
    try:
        profile = _open_profile(data)
        if profile.profile.xcolor_space.strip() == "RGB" and image.mode in ("L", "LA", "P", "PA", "RGB", "RGBA"):
            image = image.convert("RGBA" if has_alpha(image) else "RGB")
        change = _find_transform(data, image.mode)
        if change is None:
            return picture
        colored = change.apply(image)
    except (ImageCms.PyCMSError, ValueError, TypeError, OSError):
        return replace(picture, notes=(IGNORED,))
    colored.format = picture.image.format
    colored.info = {key: value for key, value in image.info.items() if key != "icc_profile"}
    name = printable_text(ImageCms.getProfileDescription(profile)) or "its color profile"
    return replace(picture, image=colored, recolored=True, notes=(f"colors converted from {name} to sRGB",))


def _open_profile(data: bytes) -> ImageCms.ImageCmsProfile:
    """Return a profile; without bytes, that of CIE L*a*b*, which needs none."""
    return ImageCms.ImageCmsProfile(BytesIO(data) if data else ImageCms.createProfile("LAB"))


@lru_cache(maxsize=8)
def _find_transform(data: bytes, mode: str) -> ImageCms.ImageCmsTransform | None:
    """Return the change of colors from a profile to sRGB; None if that hardly changes any."""
    change = ImageCms.buildTransform(
        _open_profile(data),
        ImageCms.createProfile("sRGB"),
        mode,
        mode if mode == "RGBA" else "RGB",
        ImageCms.Intent.RELATIVE_COLORIMETRIC,
        ImageCms.Flags.BLACKPOINTCOMPENSATION,
    )
    if mode not in ("L", "RGB", "RGBA"):
        return change
    levels = np.linspace(0, 255, 18).astype(np.uint8)
    colors = np.stack(np.meshgrid(levels, levels, levels), axis=-1).reshape(18, -1, 3)
    probe = Image.fromarray(colors).convert(mode)
    seen = np.asarray(change.apply(probe).convert("RGB"), int)
    return change if np.abs(seen - np.asarray(probe.convert("RGB"), int)).max() > SAME_LEVELS else None


def has_alpha(image: Image.Image) -> bool:
    """Return whether pixels of a picture may be transparent."""
    return image.mode in ("RGBA", "RGBa", "LA", "La", "PA") or "transparency" in image.info


OPAQUE = 224
"""Least alpha of a pixel that belongs to the photo: below, at soft edges, the background shows through."""


def opaque_pixels(image: Image.Image) -> BoolArray:
    """Return the (H, W) pixels of a picture that are not transparent."""
    if not has_alpha(image):
        return np.full((image.height, image.width), True)
    return np.asarray(image.convert("RGBA").getchannel("A")) >= OPAQUE


def fill_masked(pixels: ByteArray, used: BoolArray) -> ByteArray:
    """Return an RGB photo whose masked pixels have the color of the nearest usable one, for interpolation."""
    if used.all() or not used.any():
        return pixels
    hidden = (~used).view(np.uint8)
    _, nearest = cv2.distanceTransformWithLabels(hidden, cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL)
    seeds = np.flatnonzero(used)
    place = np.zeros(len(seeds) + 1, np.int64)  # labels count from 1
    place[nearest.ravel()[seeds]] = seeds
    return np.asarray(pixels.reshape(-1, 3)[place[nearest]])


def upright_image(picture: DecodedPhoto) -> Image.Image:
    """Return the picture upright by EXIF, in 8-bit RGB or gray; transparent pixels take the color beside them."""
    return undo_exif_orientation(_to_eight_bit(picture.image), orientation(picture.exif))


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


def undo_exif_orientation(image: Image.Image, orientation: int) -> Image.Image:
    """Turn an image as stored upright; orientations outside of 2 to 8 leave it unchanged."""
    return image.transpose(ORIENTATIONS[orientation]) if orientation in ORIENTATIONS else image


def rotate_to_sensor(upright: Image.Image, turn_deg: int) -> Image.Image:
    """Turn an upright image back to the sensor's orientation, which is upright after 0, 90, 180 or 270 degrees."""
    turns = {90: Image.Transpose.ROTATE_90, 180: Image.Transpose.ROTATE_180, 270: Image.Transpose.ROTATE_270}
    return upright.transpose(turns[turn_deg]) if turn_deg else upright


def _to_eight_bit(image: Image.Image) -> Image.Image:
    if image.mode.startswith("I") or image.mode == "F":
        return Image.fromarray(_to_gray_levels(np.asarray(image)))
    if has_alpha(image):
        colors = np.asarray(image.convert("RGBA"))[..., :3]
        return Image.fromarray(fill_masked(colors, opaque_pixels(image)))
    return image if image.mode in ("RGB", "L") else image.convert("RGB")


def _to_gray_levels(deep: NDArray[Any]) -> ByteArray:
    """Map gray of 16 bits or any other range to 256 levels."""
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
        return DAMAGED if "AVIF" in formats() else "AVIF photos need a newer Pillow: `pip install -U pillow`"
    if head.startswith(ICONS):
        return "an icon"
    named = next((f"{name}: {SAVE_IT}" for name, heads in UNREAD.items() if head.startswith(heads)), "")
    return named or _unusual_coding(path) or "not a photo"


def _unusual_coding(path: Path) -> str:
    """Return the name of a JPEG or TIFF that its decoder does not know, and what to do; empty for others."""
    try:
        with path.open("rb") as file:
            head = file.read(HEAD_BYTES)
            if head[:4] in TIFF_HEADS:
                pictures = _list_tiff(file, head[: 16 if head[2:4] in (b"+\0", b"\0+") else 8])
                what = _unusual_tiff(next(iter(pictures.values())))
            elif head[:4] == b"8BPS":
                what = "" if head[23] in (1, 8) else f"a Photoshop file of {head[23]} bits"
            else:
                what = _unusual_jpeg(_parse_jpeg(path.read_bytes())) if head[:2] == b"\xff\xd8" else ""
    except Exception:  # damaged bytes raise anything
        return ""
    return f"{what}: {SAVE_IT}" if what else ""


def _unusual_tiff(tags: ImageFileDirectory_v2) -> str:
    """Return the name of a TIFF of a compression or of numbers that Pillow does not know; empty for others."""
    compression, channels = tags.get(Base.Compression, 1), tags.get(Base.SamplesPerPixel, 1)
    bits, kind = max(tags.get(Base.BitsPerSample, (1,))), max(tags.get(Base.SampleFormat, (1,)))
    if compression not in COMPRESSION_INFO:
        return f"a TIFF of compression {compression}"
    if channels <= 4 and bits <= (32 if channels == 1 else 16) and (kind != 3 or bits == 32):
        return ""
    numbers = "floating-point numbers" if kind == 3 else "numbers"
    return f"a TIFF with {numbers} of {bits} bits, channels: {channels}"


def _unusual_jpeg(jpeg: _Jpeg) -> str:
    """Return the name of a JPEG that not all decoders know; empty for others."""
    if jpeg.coding % 4 == 3:
        return "a lossless JPEG"
    if jpeg.coding > 0xC8:
        return "a JPEG in arithmetic coding"
    if jpeg.coding > 0xC4:
        return "a hierarchical JPEG"
    return f"a JPEG of {jpeg.frame[0]} bits" if jpeg.frame and jpeg.frame[0] == 12 else ""


# Small pictures of photos, for pages.


def small_jpeg(path: Path, side: int, *, upright: bool = False) -> bytes:
    """Return a picture of a photo as JPEG, at most `side` pixels long; empty if the photo is unreadable.

    With `upright`, it is turned as EXIF says.
    """
    formats()  # so that Pillow knows HEIC, where it can
    try:
        with Image.open(path) as image:
            image.draft("RGB", (side, side))
            small = undo_exif_orientation(image.convert("RGB"), orientation(image.getexif()) if upright else 1)
            small.thumbnail((side, side))
            file = BytesIO()
            small.save(file, "JPEG", quality=72)
    except (OSError, ValueError, Image.DecompressionBombError) as err:  # the photo may be gone
        logger.info("no picture of %s", path.name, exc_info=err)
        return b""
    return file.getvalue()
