"""Damaged photos, and files that are made to be a nuisance: each is a photo, or is left out with a reason."""

import io
import json
import struct
import subprocess
import sys
import zlib
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from PIL import Image, ImageCms, features

from sfm_app.api import open_run
from sfm_app.photos.probe import read_photo
from sfm_app.photos.selection import PhotoStats
from sfm_app.photos.source import read_source
from sfm_app.settings import PhotoSettings, Settings
from sfm_app.stages import match_graph
from sfm_app.stages import photos as photo_stage
from tests.unit.photos.test_containers import dng

from .mutations import ANYTHING, damaged, exif_block, jpeg_segments

linux = pytest.mark.skipif(not sys.platform.startswith("linux"), reason="limits of processes")

SECONDS, MEGABYTES = 5, 1500
PER_FORMAT = 100
FORMATS = {
    "jpg": ("JPEG", {}), "progressive.jpg": ("JPEG", {"progressive": True}), "png": ("PNG", {}),
    "tif": ("TIFF", {"compression": "tiff_lzw"}), "raw.tif": ("TIFF", {}), "webp": ("WEBP", {}), "bmp": ("BMP", {}),
    "jp2": ("JPEG2000", {}), "gif": ("GIF", {}), "tga": ("TGA", {"compression": "tga_rle"}), "sgi": ("SGI", {}),
    "icc.jpg": ("JPEG", {"icc_profile": ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()}),
    "dng": ("DNG", {}),
}  # fmt: skip

EXIF = ("JPEG", "PNG", "TIFF", "WEBP")


def picture():
    """Soft blots with features."""
    blots = Image.fromarray(np.random.default_rng(0).integers(0, 255, (24, 32, 3), np.uint8))
    return blots.resize((160, 120), Image.Resampling.BICUBIC)


def saved(kind):
    name, options = FORMATS[kind]
    if name == "DNG":
        return dng()
    exif = Image.Exif()
    exif[0x0110], exif[0x0112] = "Box Brownie", 1
    exif.get_ifd(0x8769)[0xA405] = 28
    exif.get_ifd(0x8825)[2] = (51.0, 30.0, 0.0)
    buffer = io.BytesIO()
    picture().save(buffer, name, **options, **({"exif": exif} if name in EXIF else {}))
    return buffer.getvalue()


def mutants(kind, seeds):
    """Damaged files of a format, and how to get them again."""
    whole = saved(kind)
    kinds = (*ANYTHING, exif_block, *[jpeg_segments] * (3 if kind.endswith("jpg") else 0))
    for seed in seeds:
        data, how = damaged(whole, seed, kinds)
        if data != whole:
            yield seed, data, how


def read_all(folder):
    """What became of each photo of a folder, and MB that this took, in a process of its own."""
    script = Path(__file__).with_name("reader.py")
    command = [sys.executable, "-W", "ignore", str(script), str(folder), str(SECONDS), str(MEGABYTES)]
    process = subprocess.run(command, capture_output=True, text=True, check=False, timeout=300)
    said = [json.loads(line) for line in process.stdout.splitlines()]
    assert process.returncode == 0, f"ended with {process.returncode} at {said[-1]}: {process.stderr[-500:]}"
    return dict(zip(said[1:-1:2], said[2:-1:2], strict=True)), said[-1] - said[0]


@linux
@pytest.mark.parametrize("kind", FORMATS)
def test_every_damaged_file_is_a_photo_or_has_a_reason(tmp_path, kind):
    made = {}
    for seed, data, how in mutants(kind, range(PER_FORMAT)):
        made[f"{seed:04d}.{kind}"] = how
        (tmp_path / f"{seed:04d}.{kind}").write_bytes(data)
    found, megabytes = read_all(tmp_path)
    assert found.keys() == made.keys()
    assert megabytes < 700  # a head may claim 178 million pixels, as photos may have them
    assert all(reason.isprintable() and len(reason) < 100 for reason in found.values())
    kinds = Counter(found.values())
    assert sum(kinds.values()) - kinds[""] > 0 and len(made) > 0.9 * PER_FORMAT


def chunk(name, data):
    return struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))


def png(width, height, extra=b""):
    """A picture of one color."""
    packer, row = zlib.compressobj(9), bytes(1 + 4 * width)
    data = b"".join(packer.compress(row) for _ in range(height)) + packer.flush()
    head = struct.pack(">IIBBBBB", width, height, 8, 6, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + extra + chunk(b"IDAT", data) + chunk(b"IEND", b"")


def tiff(frames, *, ring=False):
    """So many pictures in one file, or the last followed by the first."""
    side = 64
    tags = [(256, side), (257, side), (258, 8), (259, 1), (262, 1), (273, 8), (277, 1), (278, side), (279, side**2)]
    first, size = 8 + side**2, 2 + 12 * len(tags) + 4
    entries = struct.pack("<H", len(tags)) + b"".join(struct.pack("<HHII", tag, 4, 1, value) for tag, value in tags)
    pages = [entries + struct.pack("<I", first + (k + 1) * size) for k in range(frames)]
    pages[-1] = entries + struct.pack("<I", first if ring else 0)
    return b"II*\0" + struct.pack("<I", first) + bytes(range(256)) * (side**2 // 256) + b"".join(pages)


def webp(width, height):
    buffer = io.BytesIO()
    Image.new("RGB", (width, height)).save(buffer, "WEBP", lossless=True, method=0)
    return buffer.getvalue()


def avif(width, height):
    """The size in its head is not the size of its pixels."""
    buffer = io.BytesIO()
    picture().save(buffer, "AVIF")
    return buffer.getvalue().replace(struct.pack(">II", 160, 120), struct.pack(">II", width, height))


BILLION = 40_000, 25_000


def patched(kind, old, new):
    """A photo whose head claims another size, without a check sum that gives it away."""
    buffer = io.BytesIO()
    picture().save(buffer, kind)
    data = buffer.getvalue()
    assert old in data
    data = data.replace(old, new)
    if kind == "PNG":
        data = data[:29] + struct.pack(">I", zlib.crc32(data[12:29])) + data[33:]
    return data


NUISANCES = {
    "pixels of one color": lambda: png(9_000, 6_000),
    "WebP of one color": lambda: webp(9_000, 6_000),
    "a hundred megabytes of text": lambda: png(80, 80, chunk(b"zTXt", b"x\0\0" + zlib.compress(bytes(10**8), 1))),
    "a hundred megabytes of colors": lambda: png(80, 80, chunk(b"iCCP", b"x\0\0" + zlib.compress(bytes(10**8), 1))),
    "a hundred thousand pictures": lambda: tiff(100_000),
    "pictures in a ring": lambda: tiff(3, ring=True),
    "PNG of a billion pixels": lambda: patched("PNG", struct.pack(">II", 160, 120), struct.pack(">II", *BILLION)),
    "TIFF of a billion pixels": lambda: patched(
        "TIFF",
        struct.pack("<HHIIHHII", 256, 4, 1, 160, 257, 4, 1, 120),
        struct.pack("<HHIIHHII", 256, 4, 1, BILLION[0], 257, 4, 1, BILLION[1]),
    ),
    "JPEG 2000 of a billion pixels": lambda: patched(
        "JPEG2000", struct.pack(">II", 120, 160), struct.pack(">II", *BILLION)
    ).replace(struct.pack(">II", 160, 120), struct.pack(">II", *BILLION)),
    "WebP of the most pixels": lambda: patched(
        "WEBP", (160 | 120 << 16).to_bytes(4, "little"), (16_383 | 16_383 << 16).to_bytes(4, "little")
    ),
    "AVIF with a large head": lambda: avif(60_000, 60_000) if features.check("avif") else png(20_000, 9_000),
}


@linux
def test_bombs_are_refused_or_cost_little(tmp_path):
    names = {f"{number}.x": name for number, name in enumerate(NUISANCES)}
    for file, name in names.items():
        (tmp_path / file).write_bytes(NUISANCES[name]())

    found, megabytes = read_all(tmp_path)

    assert megabytes < 200
    assert {names[file]: reason for file, reason in found.items()} == {
        "pixels of one color": "too many pixels for a file of its size",
        "WebP of one color": "too many pixels for a file of its size",
        "a hundred megabytes of text": "truncated or damaged",
        "a hundred megabytes of colors": "truncated or damaged",
        "a hundred thousand pictures": "",
        "pictures in a ring": "",
        **dict.fromkeys((name for name in NUISANCES if name.endswith("billion pixels")), "too many pixels"),
        "WebP of the most pixels": "too many pixels",
        "AVIF with a large head": "truncated or damaged" if features.check("avif") else "too many pixels",
    }


def test_of_very_many_pictures_the_first_is_used(tmp_path):
    (tmp_path / "x.tif").write_bytes(tiff(101))
    (tmp_path / "y.tif").write_bytes(tiff(100))
    notes = [read_photo(tmp_path, name, options=PhotoSettings()).photo.notes for name in ("x.tif", "y.tif")]
    assert notes == [("the largest of more than 100 pictures",), ("the largest of its 100 pictures",)]


ACCEPTED = 40


def accepted(folder):
    """Damaged photos that we take for photos."""
    folder.mkdir()
    for seed, data, _ in mutants("jpg", range(2 * PER_FORMAT, 6 * PER_FORMAT)):
        path = folder / f"{seed:04d}.jpg"
        path.write_bytes(data)
        if not isinstance(read_photo(folder, path.name, options=PhotoSettings()), PhotoStats):
            path.unlink()
        elif len(list(folder.iterdir())) == ACCEPTED:
            break
    return sorted(path.name for path in folder.iterdir())


def test_colmap_survives_the_damaged_photos_that_we_accept(tmp_path):
    """COLMAP decodes them once more, in ways of its own."""
    names = accepted(tmp_path / "photos")
    flags = (
        "--keep-low-quality", "--set", "matching.max_features=100", "-q", "--workers", "2", "--until", "match_graph",
    )  # fmt: skip
    command = [sys.executable, "-m", "sfm_app", "run", str(tmp_path / "photos"), "-o", str(tmp_path / "out"), *flags]
    process = subprocess.run(command, capture_output=True, text=True, check=False, timeout=300)
    assert process.returncode == 0, process.stderr
    assert process.stderr == ""  # not even Pillow's warnings about EXIF
    stages = json.loads((tmp_path / "out" / "manifest.json").read_text())["stages"]
    keypoints = stages["match_graph"]["counts"]["keypoints"]
    assert sorted(keypoints) == names and len(names) == ACCEPTED
    assert all(count > 0 for count in keypoints.values())


def noise(path):
    path.write_bytes(b"noise" * 99)


def another_size(path):
    picture().resize((100, 80)).save(path)


@pytest.mark.parametrize("change", [noise, another_size])
def test_photos_that_colmap_cannot_read_have_no_keypoints(photos, tmp_path, change):
    """Neither a crash nor the end of the run: the scene says that no features were found."""
    settings = Settings.from_mapping({"matching": {"max_features": 300}})
    with open_run(tmp_path / "out", settings, None) as run:
        run.workspace.create()
        photo_set = photo_stage.make(read_source(photos, run.workspace.root, settings.photos, map), run)
        path = run.workspace.photos / "view_02.jpg"
        path.unlink()
        change(path)
        found = match_graph.make(photo_set, run)
    assert [image.name for image in found.images.values() if not len(found.keypoints[image.id])] == [path.name]
    assert run.statistics["keypoints"][path.name] == 0
