"""Masks: which file is whose, what in it counts as masked, and that it lies on the photo as people see it."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from sfm_app.photos.decode import fill_masked
from sfm_app.photos.masks import assign_masks, check_mask, lay_out_mask, list_masks, read_mask, unused_masks
from sfm_app.types import Photo, UnusablePhoto

USED = np.zeros((40, 60), bool)
USED[5:35, 20:50] = True
USED[:10, 30:] = False
GRAY = np.where(USED, np.uint8(255), np.uint8(0))


@pytest.fixture
def masks(tmp_path):
    place = tmp_path / "masks"
    (place / "sub").mkdir(parents=True)
    return place


@pytest.fixture
def photos(tmp_path):
    place = tmp_path / "photos"
    place.mkdir()
    return place


def photo(name="a.jpg", width=60, height=40):
    return Photo(name, width, height, "g")


def find_mask(photo, photos, masks):
    """The photo with its mask, where that is of use."""
    (assigned,) = assign_masks([photo], list_masks(str(masks), photos, photos / "out"))
    return check_mask(assigned, photos, masks)


def laid_out(found, photos, masks, tmp_path):
    lay_out_mask(found, photos, masks, tmp_path / "laid out")
    return read_mask(tmp_path / "laid out", found.name)


@pytest.mark.parametrize(
    ("name", "there", "expected"),
    [
        ("sub/a.jpg", ("sub/a.jpg.png", "sub/a.png"), "sub/a.jpg.png"),
        ("sub/a.jpg", ("sub/a.png",), "sub/a.png"),
        ("sub/a.jpg", ("a.jpg.png", "a.png", "sub/ab.jpg"), ""),
        ("sub/a.jpg", ("sub/a.jpg", "sub/a.jpg.jpg"), "sub/a.jpg.jpg"),
        ("sub/a.jpg", ("sub/a_mask.png", "sub/b_mask.png"), "sub/a_mask.png"),
        ("sub/a.jpg", ("sub/a.JPG.png", "sub/a.mask.jpeg"), "sub/a.mask.jpeg"),
        ("a.png", ("mask_a.tif", "mask_b.tif"), "mask_a.tif"),
        ("a.png", ("a.png.png",), "a.png.png"),
        ("a.png", ("a.png",), "a.png"),
        ("a", ("a.png",), "a.png"),
        ("a.b.jpg", ("a.png", "b.png"), ""),
        ("a.b.jpg", ("a.b.png",), "a.b.png"),
    ],
)
def test_masks_are_named_as_colmap_names_them(photos, masks, name, there, expected):
    for mask in there:
        Image.fromarray(GRAY).save(masks / mask, "PNG")
    found = find_mask(photo(name), photos, masks)
    assert found == replace(photo(name), mask=expected)
    assert unused_masks(list_masks(str(masks), photos, photos / "out"), [found]) == sorted(set(there) - {expected})


def palette():
    image = Image.fromarray(np.where(USED, np.uint8(7), np.uint8(3)), "P")
    image.putpalette([9, 9, 9] * 3 + [0, 0, 0] + [9, 9, 9] * 3 + [0, 1, 0])
    return image


def cut_out():
    """What programs that take away a background save: the pixels behind it are still there."""
    return Image.fromarray(np.dstack([np.full((*USED.shape, 3), 90, np.uint8), GRAY]))


KINDS = {
    "gray": lambda: Image.fromarray(GRAY),
    "faint": lambda: Image.fromarray(GRAY // 255),
    "two levels": lambda: Image.fromarray(GRAY).convert("1"),
    "palette": palette,
    "blue": lambda: Image.fromarray(np.dstack([0 * GRAY, 0 * GRAY, GRAY])),
    "black and opaque": lambda: Image.fromarray(GRAY).convert("RGBA"),
    "transparent": cut_out,
    "transparent gray": lambda: cut_out().convert("LA"),
    "16 bits": lambda: Image.fromarray(np.where(USED, np.uint16(1), np.uint16(0))),
}


@pytest.mark.parametrize("kind", KINDS)
def test_black_and_transparent_is_masked_and_all_else_is_used(photos, masks, tmp_path, kind):
    KINDS[kind]().save(masks / "a.jpg.png")
    found = find_mask(photo(), photos, masks)
    np.testing.assert_array_equal(laid_out(found, photos, masks, tmp_path), USED)
    with Image.open(tmp_path / "laid out" / "a.jpg.png") as image:
        assert (image.mode, sorted(set(image.tobytes()))) == ("L", [0, 255])


@pytest.mark.parametrize(
    "mask", [np.where(USED, 255, 3), np.where(USED, 250, 20), np.where(USED, 65535, 900), np.where(USED, 2, 0)]
)
def test_what_is_nearly_black_is_masked(photos, masks, tmp_path, mask):
    Image.fromarray(mask.astype(np.uint16 if mask.max() > 255 else np.uint8)).save(masks / "a.png")
    np.testing.assert_array_equal(laid_out(find_mask(photo(), photos, masks), photos, masks, tmp_path), USED)


@pytest.mark.parametrize("quality", [50, 75, 95])
def test_masks_may_be_jpegs(photos, masks, tmp_path, quality):
    Image.fromarray(GRAY).convert("RGB").save(masks / "a_mask.jpg", quality=quality)
    seen = laid_out(find_mask(photo(), photos, masks), photos, masks, tmp_path)
    assert (seen != USED).mean() < 0.01
    Image.fromarray(GRAY // 40).save(masks / "a_mask.jpg", quality=quality)
    assert find_mask(photo(), photos, masks) == UnusablePhoto("a.jpg", "its mask is all black")


def test_a_single_mask_of_no_photo_is_that_of_all(photos, masks):
    several = [photo("a.jpg"), photo("sub/b.jpg")]
    assert [one.mask for one in assign_masks(several, ["hood.png", ".DS_Store"])] == ["hood.png"] * 2
    assert [one.mask for one in assign_masks(several, ["a.png"])] == ["a.png", ""]
    assert [one.mask for one in assign_masks(several, ["a.png"], for_all=True)] == ["a.png"] * 2
    assert [one.mask for one in assign_masks(several, ["hood.png", "tripod.png"])] == ["", ""]


def test_a_mask_tells_whether_it_hides_anything(photos, masks, tmp_path):
    for name, gray in (("a.png", GRAY), ("b.png", GRAY | 255)):
        Image.fromarray(gray).save(masks / name)
        found = find_mask(photo(name), photos, masks)
        assert lay_out_mask(found, photos, masks, tmp_path / "laid out") == (name == "a.png")


def test_without_a_mask_all_is_used_and_masks_go_by_the_name_of_the_photo_in_the_run(photos, masks, tmp_path):
    assert laid_out(find_mask(photo(), photos, masks), photos, masks, tmp_path).all()
    Image.fromarray(GRAY).save(masks / "a.webp.png")
    found = find_mask(photo("a.webp"), photos, masks)
    seen = laid_out(replace(found, name="a.webp.jpg", original="a.webp"), photos, masks, tmp_path)
    np.testing.assert_array_equal(seen, USED)


@pytest.mark.parametrize("times", [0.5, 2, 3])
def test_masks_of_another_size_are_brought_to_that_of_the_photo(photos, masks, tmp_path, times):
    Image.fromarray(GRAY).save(masks / "a.jpg.png")
    size = round(60 * times), round(40 * times)
    seen = laid_out(find_mask(photo("a.jpg", *size), photos, masks), photos, masks, tmp_path)
    y, x = np.mgrid[: size[1], : size[0]] + 0.5
    np.testing.assert_array_equal(seen, USED[(y / times).astype(int), (x / times).astype(int)])


@pytest.mark.parametrize("size", [(61, 41), (120, 81), (600, 399), (29, 20)])
def test_a_pixel_more_or_less_is_the_same_shape(photos, masks, size):
    Image.fromarray(GRAY).save(masks / "a.jpg.png")
    assert find_mask(photo("a.jpg", *size), photos, masks).mask == "a.jpg.png"


TURNED = {1: USED, 3: USED[::-1, ::-1], 6: np.rot90(USED, -1), 8: np.rot90(USED, 1)}


@pytest.mark.parametrize("orientation", TURNED)
@pytest.mark.parametrize("drawn", ["as seen", "as filed", "with EXIF"])
def test_masks_of_photos_that_exif_turns(photos, masks, tmp_path, orientation, drawn):
    upright, exif = TURNED[orientation], Image.Exif()
    exif[0x0112] = orientation
    Image.fromarray(GRAY).save(photos / "a.jpg", exif=exif)
    pixels, tags = (upright, {}) if drawn == "as seen" else (USED, {"exif": exif} if drawn == "with EXIF" else {})
    if (orientation, drawn) == (3, "as filed"):
        pixels = upright  # nothing tells a mask upside down from one that is not: as seen
    Image.fromarray(np.ascontiguousarray(np.where(pixels, np.uint8(9), np.uint8(0)))).save(masks / "a.png", **tags)
    found = find_mask(photo("a.jpg", *upright.shape[::-1]), photos, masks)
    np.testing.assert_array_equal(laid_out(found, photos, masks, tmp_path), upright)


def test_photos_and_output_inside_the_folder_of_masks_are_no_masks(tmp_path):
    for name in ("photos/a.jpg", "out/masks/a.jpg.png", "a.jpg.png", ".DS_Store"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_bytes(b"x")
    names = list_masks(str(tmp_path), tmp_path / "photos", tmp_path / "out")
    assert names == [".DS_Store", "a.jpg.png"]
    assert unused_masks(names, [photo()]) == ["a.jpg.png"]


@given(st.integers(0, 2**32 - 1), st.sampled_from([0.02, 0.5, 0.98]))
def test_masked_pixels_take_the_color_of_the_nearest_that_is_not(seed, share):
    rng = np.random.default_rng(seed)
    used = rng.random((9, 13)) < share
    used[rng.integers(9), rng.integers(13)] = True
    pixels = rng.integers(0, 255, (9, 13, 3), np.uint8)

    seen = fill_masked(pixels, used)

    np.testing.assert_array_equal(seen[used], pixels[used])
    y, x = np.nonzero(used)
    for row, col in zip(*np.nonzero(~used), strict=True):
        same = (pixels[y, x] == seen[row, col]).all(axis=1)
        distance = np.hypot(y - row, x - col)
        assert distance[same].min() < 1.1 * distance.min() + 0.5  # the transform is not exact
