"""Files with several pictures: the photo is the largest whole one, and raw photos are developed or named."""

import struct

import numpy as np
import pytest
from PIL import Image

from sfm_app.photos import decode
from sfm_app.photos.decode import UnreadableError, orientation, read_picture, upright_image
from sfm_app.photos.files import list_photos

PREVIEW, WHOLE, MASK, FILTER_ARRAY = 1, 0, 4, 32803


CODES = {1: "B", 2: "B", 3: "H", 4: "I", 10: "i", 16: "Q"}
"""How Python packs the kinds of TIFF's values."""


def noise(width, height, seed=0):
    return np.random.default_rng(seed).integers(0, 255, (height, width, 3), np.uint8)


def tiff(*pictures, order="<", wide=False):
    """A TIFF of pictures (pixels, tags, pictures in its SubIFDs), each in one strip without compression."""
    start = b"II" if order == "<" else b"MM"
    data = bytearray(start + (struct.pack(order + "HHHQ", 43, 8, 0, 0) if wide else struct.pack(order + "HI", 42, 0)))
    long, kind = ("Q", 16) if wide else ("I", 4)

    def put(values, code):
        data.extend(bytes(-len(data) % 8))
        place = len(data)
        data.extend(struct.pack(f"{order}{len(values)}{code}", *values))
        return place

    def write(picture):
        """Append a picture; return the places of it and of the pointer to the next one."""
        pixels, tags, inner = picture
        below = [write(one)[0] for one in inner]
        strip = put(pixels.tobytes(), "B")
        height, width, *depth = pixels.shape
        bits = pixels.itemsize * 8
        entries = {256: (3, [width]), 257: (3, [height]), 258: (3, [bits] * (*depth, 1)[0]), 259: (3, [1]),
                   262: (3, [2 if depth else 1]), 273: (kind, [strip]), 277: (3, [(*depth, 1)[0]]),
                   278: (3, [height]), 279: (kind, [pixels.nbytes])} | tags  # fmt: skip
        if below:
            entries[330] = (kind, below)
        rows = []
        for tag, (code, values) in sorted(entries.items()):
            packed = struct.pack(f"{order}{len(values)}{CODES[code]}", *values)
            room = 8 if wide else 4
            at = packed.ljust(room, b"\0") if len(packed) <= room else struct.pack(order + long, put(packed, "B"))
            count = len(values) // 2 if code == 10 else len(values)
            rows.append(struct.pack(f"{order}HH{long}", tag, code, count) + at)
        place = put(struct.pack(order + ("Q" if wide else "H"), len(rows)) + b"".join(rows), "B")
        return place, put_pointer()

    def put_pointer():
        data.extend(bytes(8 if wide else 4))
        return len(data) - (8 if wide else 4)

    pointer = 8 if wide else 4
    for picture in pictures:
        place, following = write(picture)
        struct.pack_into(order + long, data, pointer, place)
        pointer = following
    return bytes(data)


def tags(kind=None, **more):
    return ({} if kind is None else {254: (4, [kind])}) | more.get("extra", {})


SMALL, LARGE = noise(16, 12, 1), noise(64, 48, 2)
CONTAINERS = {
    "a preview first": [(SMALL, tags(PREVIEW), []), (LARGE, tags(WHOLE), [])],
    "a preview last": [(LARGE, tags(WHOLE), []), (SMALL, tags(PREVIEW), [])],
    "the photo within the preview": [(SMALL, tags(PREVIEW), [(LARGE, tags(WHOLE), [])])],
    "previews within the photo": [(LARGE, tags(WHOLE), [(SMALL, tags(PREVIEW), []), (SMALL, tags(PREVIEW), [])])],
    "no word about previews": [(SMALL, tags(), []), (LARGE, tags(), [])],
    "the old word": [(SMALL, {255: (3, [2])}, []), (LARGE, {255: (3, [1])}, [])],
    "a large mask": [(LARGE, tags(WHOLE), []), (noise(128, 96), tags(MASK), [])],
    "only a preview": [(LARGE, tags(PREVIEW), [])],
}


@pytest.mark.parametrize(("order", "wide"), [("<", False), (">", False), ("<", True)])
@pytest.mark.parametrize("kind", CONTAINERS)
def test_the_largest_whole_picture_is_the_photo(tmp_path, kind, order, wide):
    (tmp_path / "x.tif").write_bytes(tiff(*CONTAINERS[kind], order=order, wide=wide))
    picture = read_picture(tmp_path / "x.tif")
    np.testing.assert_array_equal(upright_image(picture), LARGE)
    assert picture.frames == (2 if kind == "no word about previews" else 1)


@pytest.mark.parametrize("within", [{}, {274: (3, [6])}])
def test_the_orientation_of_the_file_holds_for_the_photo_in_it(tmp_path, within):
    picture = (SMALL, tags(PREVIEW) | {274: (3, [6])}, [(LARGE, tags(WHOLE) | within, [])])
    (tmp_path / "x.tif").write_bytes(tiff(picture))
    np.testing.assert_array_equal(upright_image(read_picture(tmp_path / "x.tif")), np.rot90(LARGE, -1))


def dng():
    """A raw photo with a preview first, as DNG; its scene is gray."""
    sensor = np.full((96, 128), 20_000, np.uint16)
    matrix = [*(10_000, 10_000), *(0, 10_000) * 3] * 2 + [10_000, 10_000]
    raw = {254: (4, [WHOLE]), 262: (3, [FILTER_ARRAY]), 33421: (3, [2, 2]), 33422: (1, [0, 1, 1, 2])}
    main = {254: (4, [PREVIEW]), 272: (2, [*b"Model\0"]), 274: (3, [6]),
            50706: (1, [1, 4, 0, 0]), 50708: (2, [*b"Model\0"]), 50721: (10, matrix), 50778: (3, [21])}  # fmt: skip
    return tiff((SMALL, main, [(sensor, raw, [])]))


RAW = {
    "DNG": dng(), "Canon": b"II*\0\x10\0\0\0CR\x02\0" + bytes(99), "Fujifilm": b"FUJIFILMCCD-RAW 0201" + bytes(99),
    "Olympus": b"IIRO\x08\0\0\0" + bytes(99), "Canon CR3": b"\0\0\0\x18ftypcrx \0\0\0\1" + bytes(99),
}  # fmt: skip


@pytest.mark.parametrize("kind", RAW)
def test_raw_photos_name_the_extra_where_it_is_not_installed(tmp_path, monkeypatch, kind):
    def no_rawpy(name):
        raise ImportError(name)

    monkeypatch.setattr(decode.importlib, "import_module", no_rawpy)
    decode.formats.cache_clear()
    (tmp_path / "x.dng").write_bytes(RAW[kind])
    with pytest.raises(UnreadableError, match=r"^a raw photo: develop it .* or pip install 'sfm-app\[raw\]'$"):
        read_picture(tmp_path / "x.dng")
    decode.formats.cache_clear()


def test_raw_photos_are_developed_where_the_extra_is_installed(tmp_path):
    pytest.importorskip("rawpy")
    (tmp_path / "x.dng").write_bytes(RAW["DNG"])
    picture = read_picture(tmp_path / "x.dng")
    assert (picture.image.size, orientation(picture.exif), picture.exif[0x0110]) == ((128, 96), 6, "Model")
    (tmp_path / "x.dng").write_bytes(RAW["Fujifilm"])
    with pytest.raises(UnreadableError, match="truncated or damaged"):
        read_picture(tmp_path / "x.dng")


def test_of_a_raw_photo_and_its_developed_twin_one_is_used(tmp_path):
    for name in ("IMG_1.CR2", "IMG_1.JPG", "IMG_2.CR2", "other/IMG_2.jpg"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        Image.new("RGB", (60, 40)).save(tmp_path / name, "PNG")
    found = list_photos(tmp_path, tmp_path / "out")
    assert [name for name, reason in found.items() if reason] == ["IMG_1.CR2"]
