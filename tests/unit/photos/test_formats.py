"""Every format and mode of photos: read as it was written, or left out by its name."""

import struct
from collections import defaultdict
from io import BytesIO
from pathlib import Path

import cv2
import numpy as np
import PIL
import pytest
from PIL import Image, ImageCms

from sfm_app.photos.decode import read_picture, upright_image
from sfm_app.photos.probe import read_photo
from sfm_app.photos.selection import PhotoStats
from sfm_app.settings import PhotoSettings
from tests.unit.photos.tables import check_table
from tests.unit.photos.test_containers import dng

MODES = ("1", "L", "LA", "P", "PA", "RGB", "RGBA", "CMYK", "YCbCr", "LAB", "HSV", "I", "I;16", "F")
GRAY = ("1", "L", "LA", "I", "I;16", "F")
BLOTS = np.random.default_rng(0).integers(0, 255, (12, 16, 3), np.uint8)
PHOTO = Image.fromarray(BLOTS).resize((160, 120), Image.Resampling.BICUBIC)
RGB = np.asarray(PHOTO)
Image.init()


def in_mode(mode):
    if mode == "LAB":
        profiles = ImageCms.createProfile("sRGB"), ImageCms.createProfile("LAB")
        return ImageCms.profileToProfile(PHOTO, *profiles, outputMode="LAB")
    deep = {"I": np.int32, "I;16": np.uint16}
    return (
        Image.fromarray(np.asarray(PHOTO.convert("L")).astype(deep[mode]) * 257)
        if mode in deep
        else PHOTO.convert(mode)
    )


def written(image, kind, **options):
    """The bytes of a file; empty where Pillow does not write it."""
    file = BytesIO()
    try:
        image.save(file, kind, **options)
    except Exception:  # each format refuses in its own way
        return b""
    if image.mode.startswith(("I", "F")) and not Image.open(file).mode.startswith(("I", "F")):
        return b""  # clipped to 255
    return file.getvalue()


def result(folder, data, mode="RGB"):
    """What becomes of a file, and the difference to the photo where it is used, from 0 to 1."""
    (folder / "x").write_bytes(data)
    found = read_photo(folder, "x", options=PhotoSettings())
    if not isinstance(found, PhotoStats):
        return f"left out: {found.reason}", 0.0
    if data == RAW:
        return "used", 0.0  # not this photo
    truth = PHOTO.convert("L").convert("RGB") if mode in GRAY else PHOTO
    seen = upright_image(read_picture(folder / "x")).convert("RGB")
    # few colors are dots, of which the mean counts
    pixels = [cv2.blur(np.asarray(picture, np.float32), (9, 9)).ravel() for picture in (seen, truth)]
    likeness = np.corrcoef(*pixels)[0, 1] if pixels[0].std() else 0.0
    return ", ".join(("used", *found.photo.notes)), 1.0 - likeness


def patched(mark, offset, new, **options):
    """A JPEG with other bytes so far behind a marker."""
    data = bytearray(written(PHOTO, "JPEG", **options))
    at = data.index(mark) + offset
    data[at : at + len(new)] = new
    return bytes(data)


def by_opencv(suffix, pixels):
    return cv2.imencode(suffix, pixels)[1].tobytes()


def psd(bits):
    planes = (RGB if bits == 8 else RGB.astype(">u2") * 257).transpose(2, 0, 1).tobytes()
    return b"8BPS" + struct.pack(">H6xHIIHHIIIH", 1, 3, 120, 160, bits, 3, 0, 0, 0, 0) + planes


def moving(kind):
    return written(PHOTO, kind, save_all=True, append_images=[PHOTO.rotate(9)], duration=50)


RAW = dng()
UNIT = (RGB / 255.0).astype(np.float32)[..., ::-1]
OTHERS = {
    "TIFF, 16 bits, RGB": lambda: by_opencv(".tif", (UNIT * 65535).astype(np.uint16)),
    "TIFF, floating-point, RGB": lambda: by_opencv(".tif", UNIT),
    "TIFF, floating-point, 64 bits": lambda: by_opencv(".tif", UNIT[..., 0].astype(float)),
    "JPEG 2000, 16 bits, RGB": lambda: by_opencv(".jp2", (UNIT * 65535).astype(np.uint16)),
    "JPEG, progressive": lambda: written(PHOTO, "JPEG", progressive=True),
    "JPEG, 12 bits": lambda: patched(b"\xff\xc0", 4, b"\x0c"),
    "JPEG, lossless": lambda: patched(b"\xff\xc0", 1, b"\xc3"),
    "JPEG, hierarchical": lambda: patched(b"\xff\xc0", 1, b"\xc5"),
    "JPEG, arithmetic": lambda: patched(b"\xff\xc2", 1, b"\xca", progressive=True),
    "Photoshop": lambda: psd(8),
    "Photoshop, 16 bits": lambda: psd(16),
    "WebP, moving": lambda: moving("WEBP"),
    "GIF, moving": lambda: moving("GIF"),
    "PNG, moving": lambda: moving("PNG"),
    "raw (DNG)": lambda: RAW,
    "JPEG XL": lambda: b"\xff\x0a" + bytes(99),
    "JPEG XR": lambda: b"II\xbc\x01" + bytes(99),
    "OpenEXR": lambda: b"\x76\x2f\x31\x01\x02" + bytes(99),
    "Radiance HDR": lambda: by_opencv(".hdr", UNIT),
    "PFM, RGB": lambda: by_opencv(".pfm", UNIT),
}
"""Files that Pillow does not write, or writes with options; the heads of some must do."""


def test_every_format_is_read_as_it_was_written_or_named(tmp_path):
    pytest.importorskip("pillow_heif").register_heif_opener()
    pytest.importorskip("rawpy")
    results = {}
    for kind in sorted(Image.SAVE):
        modes = defaultdict(list)
        for mode in MODES:
            if data := written(in_mode(mode), kind):
                found, difference = result(tmp_path, data, mode)
                modes[found].append(mode)
                assert difference < 0.05, (kind, mode)
        results |= {(kind, found): names for found, names in modes.items()}
    used = [(kind, ", ".join(modes), found) for (kind, found), modes in results.items() if found.startswith("used")]
    left_out = defaultdict(list)
    for kind, found in results:
        left_out[found].append(kind)
    others = []
    for name, make in OTHERS.items():
        found, difference = result(tmp_path, make())
        others.append((name, "", found))
        assert difference < 0.05, name
    refused = [(", ".join(kinds), "all", found) for found, kinds in left_out.items() if not found.startswith("used")]
    if PIL.__version__ in (Path(__file__).parents[3] / "constraints.txt").read_text(encoding="utf-8"):
        check_table("photo formats", [("format", "modes", "result"), *used, *others, *refused])
