"""Statistics of photos and their file; copies, blurred photos and screenshots."""

import io
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image, ImageDraw, ImageFilter
from scipy.ndimage import uniform_filter1d

from sfm_app.photos.probe import read_photo
from sfm_app.photos.selection import PhotoStats, drop_duplicates, drop_unusable, measure_photo, read_stats, write_stats
from sfm_app.settings import PhotoSettings
from sfm_app.types import CameraPrior, GpsPosition, Photo


def boxes(seed=0, shift=0):
    """A smooth picture with edges; `shift` in pixels to the side."""
    rng = np.random.default_rng(seed)
    canvas = np.full((240, 400), 90.0)
    for _ in range(60):
        x, y, w, h = rng.integers(0, [380, 220, 90, 90])
        canvas[y : y + h, x : x + w] = rng.uniform(0, 255)
    return Image.fromarray(canvas[:, 20 + shift : 340 + shift].astype(np.uint8)).convert("RGB")


def glance(name, image):
    return measure_photo(Photo(name, *image.size, "one"), image)


def saved(image, **options):
    buffer = io.BytesIO()
    image.save(buffer, "JPEG", **options)
    return Image.open(buffer)


def names(photos):
    return [photo.name for photo in photos]


def small(image):
    return image.resize((160, 120), Image.Resampling.LANCZOS)


@pytest.mark.parametrize("change", [Image.Image.copy, lambda i: saved(i, quality=60), small, lambda i: i.convert("L")])
def test_the_largest_of_each_picture_stays(change):
    photos = [glance("copy.jpg", change(boxes())), glance("b.jpg", boxes(1))]
    kept, copies = drop_duplicates(photos)
    assert names(kept) == ["copy.jpg", "b.jpg"] and not copies
    kept, copies = drop_duplicates([*photos, glance("c", boxes().resize((640, 480), Image.Resampling.LANCZOS))])
    assert names(kept) == ["b.jpg", "c"]
    assert [(photo.name, photo.reason) for photo in copies] == [("copy.jpg", "the same picture as c")]


def test_of_two_copies_more_pixels_then_exif_then_the_larger_file_stay(tmp_path):
    exif = Image.Exif()
    exif[0x0110] = "Box Brownie"
    kinds = {"a_plain.jpg": {"quality": 95}, "b_coarse.jpg": {"quality": 60, "exif": exif},
             "c_fine.jpg": {"quality": 95, "exif": exif}}  # fmt: skip
    for name, options in kinds.items():
        boxes().save(tmp_path / name, **options)
    boxes().resize((640, 480), Image.Resampling.LANCZOS).save(tmp_path / "z_large.jpg", quality=60)
    read = {name: read_photo(tmp_path, name, options=PhotoSettings()) for name in (*kinds, "z_large.jpg")}
    for used in (["a_plain.jpg", "b_coarse.jpg"], ["b_coarse.jpg", "c_fine.jpg"], ["c_fine.jpg", "z_large.jpg"]):
        kept, copies = drop_duplicates([read[name] for name in used])
        assert (names(kept), names(copies)) == ([used[1]], [used[0]])


@pytest.mark.parametrize("shift", [4, 10, 20])
def test_a_step_to_the_side_and_another_exposure_are_other_photos(shift):
    dark = boxes().point(lambda gray: gray // 2)
    for other in (boxes(0, shift), dark):
        assert len(drop_duplicates([glance("a", boxes()), glance("b", other)])[0]) == 2


def test_blank_pictures_say_nothing():
    blank = Image.new("RGB", (320, 240), "gray")
    assert len(drop_duplicates([glance(name, blank) for name in "abc"])[0]) == 3
    assert drop_duplicates([]) == ([], [])


def test_all_copies_of_one_go_to_one():
    kept, copies = drop_duplicates([glance(name, boxes()) for name in ("c", "a", "b")])
    assert names(kept) == ["c"]
    assert {photo.reason for photo in copies} == {"the same picture as c"}


def test_of_copies_the_one_with_a_mask_stays():
    """Else what somebody has masked would be used from its copy."""
    large, copy = glance("a.jpg", boxes()), glance("b.jpg", small(boxes()))
    masked = replace(copy, photo=replace(copy.photo, mask="b.jpg.png"))
    assert names(drop_duplicates([large, copy])[0]) == ["a.jpg"]
    assert names(drop_duplicates([large, masked])[0]) == ["b.jpg"]


SIZE = (1024, 768)


def sensor_photo(seed=0, size=SIZE):
    """Boxes with fine texture, and the noise of a sensor."""
    rng = np.random.default_rng(seed)
    canvas = np.full(size[::-1], 90.0)
    for _ in range(80):
        x, y = rng.integers(0, size)
        w, h = rng.integers(10, 200, 2)
        canvas[y : y + h, x : x + w] = rng.uniform(0, 255)
    noisy = canvas + rng.normal(0, 3, canvas.shape)
    return Image.fromarray(np.clip(noisy, 0, 255).astype(np.uint8)).convert("RGB")


def smeared(image, length):
    """A camera that moved to the side."""
    return Image.fromarray(uniform_filter1d(np.asarray(image), length, axis=1, mode="wrap"))


def window(size):
    """A screenshot: areas of one color, and letters."""
    image = Image.new("RGB", size, "white")
    draw = ImageDraw.Draw(image)
    draw.rectangle((0, 0, size[0], 60), fill=(30, 60, 160))
    for line in range(10):
        draw.text((40, 100 + 30 * line), "some words of a menu that says this or that", fill="black")
    return image


def left_out(*images):
    glances = [measure_photo(Photo(f"{k}.jpg", *image.size, ""), image) for k, image in enumerate(images)]
    kept, gone = drop_unusable(glances)
    assert len(kept) + len(gone) == len(images)
    return {int(photo.name[:-4]): photo.reason for photo in gone}


SHARP = [sensor_photo(seed) for seed in range(4)]


@pytest.mark.slow
@pytest.mark.parametrize("spoil", [lambda i: i.filter(ImageFilter.GaussianBlur(14)), lambda i: smeared(i, 45)])
def test_a_photo_blurred_beyond_use_is_left_out(spoil):
    assert left_out(*SHARP, spoil(sensor_photo(9))) == {4: "blurred beyond use"}


@pytest.mark.parametrize(
    "spoil",
    [lambda i: i.filter(ImageFilter.GaussianBlur(3)), pytest.param(lambda i: smeared(i, 8), marks=pytest.mark.slow)],
)
def test_a_photo_that_is_a_little_blurred_stays(spoil):
    assert left_out(*SHARP, spoil(sensor_photo(9))) == {}


@pytest.mark.slow
def test_a_screenshot_of_another_size_is_left_out():
    assert left_out(*SHARP, sensor_photo(5), window((720, 1280))) == {5: "a screenshot or drawing, of another size"}


KEPT = {
    "blurred photos alone": lambda: [image.filter(ImageFilter.GaussianBlur(14)) for image in SHARP],
    "a dark photo": lambda: [*SHARP, sensor_photo(9).point(lambda level: level // 100)],
    "a screenshot of the size of the photos": lambda: [*SHARP, window(SIZE)],
    "a screenshot of their size on end": lambda: [*SHARP, window(SIZE[::-1])],
    "drawings alone": lambda: [window((720, 1280)), window((640, 900)), window((500, 700))],
}


@pytest.mark.parametrize("kind", KEPT)
def test_photos_that_may_be_of_use_stay(kind):
    assert left_out(*KEPT[kind]()) == {}


OPTIONS = PhotoSettings()
DIGESTS = {"a.jpg": "1", "sub/b.jpg": "2"}
FULL = Photo(
    "sub/b.jpg", 640, 480, "camera", CameraPrior("EXIF", 700.5, 28.0), True, GpsPosition(47.1, 8.2, None),
    "sub/B.webp", False, 90, ("scaled",),
    (10, 0, 600, 480), "b.png", "equirectangular", 1.25, True,
)  # fmt: skip


@pytest.fixture
def stats():
    rng = np.random.default_rng(0)
    thumbnails = rng.integers(0, 256, (2, 32, 32)).astype(np.float32)
    plain = Photo("a.jpg", 64, 64, "")
    return {"a.jpg": PhotoStats(plain, thumbnails[0], 0.301, 0.5), "sub/b.jpg": PhotoStats(FULL, thumbnails[1])}


def test_a_photo_is_the_same_after_json():
    assert Photo.from_dict(FULL.to_dict()) == FULL
    assert "time_s" not in replace(FULL, time_s=None).to_dict()


def test_statistics_come_back_as_they_were(stats, tmp_path):
    rng = np.random.default_rng(0)
    Image.fromarray(rng.integers(0, 256, (90, 120, 3), np.uint8)).save(tmp_path / "real.jpg")
    stats["real.jpg"] = read_photo(tmp_path, "real.jpg", options=OPTIONS)
    digests = DIGESTS | {"real.jpg": "3"}
    write_stats(tmp_path / "stats.npz", stats, digests, OPTIONS)
    found = read_stats(tmp_path / "stats.npz", digests, OPTIONS)
    assert list(found) == list(stats)
    for name, one in found.items():
        assert (one.photo, one.blur, one.flat) == (stats[name].photo, stats[name].blur, stats[name].flat)
        assert one.thumbnail.dtype == np.float32 and np.array_equal(one.thumbnail, stats[name].thumbnail)


def test_only_files_with_the_same_bytes_are_known(stats, tmp_path):
    path = tmp_path / "stats.npz"
    write_stats(path, stats, DIGESTS, OPTIONS)
    assert list(read_stats(path, {"a.jpg": "1", "sub/b.jpg": "3"}, OPTIONS)) == ["a.jpg"]
    assert read_stats(path, {"c.jpg": "1"}, OPTIONS) == {}
    write_stats(path, stats, {"a.jpg": "1"}, OPTIONS)
    assert list(read_stats(path, DIGESTS, OPTIONS)) == ["a.jpg"]


@pytest.mark.parametrize(("change", "known"), [({"max_megapixels": 3.0}, 0), ({"masks": "masks"}, 2)])
def test_only_settings_that_decide_how_files_are_read_matter(change, known, stats, tmp_path):
    write_stats(tmp_path / "stats.npz", stats, DIGESTS, OPTIONS)
    assert len(read_stats(tmp_path / "stats.npz", DIGESTS, OPTIONS.model_copy(update=change))) == known


def test_a_damaged_or_missing_file_knows_nothing(stats, tmp_path):
    path = tmp_path / "stats.npz"
    assert read_stats(path, DIGESTS, OPTIONS) == {}
    write_stats(path, stats, DIGESTS, OPTIONS)
    whole = path.read_bytes()

    for place in range(0, len(whole), 97):
        path.write_bytes(whole[:place] + bytes([whole[place] ^ 0xFF]) + whole[place + 1 :])
        found = read_stats(path, DIGESTS, OPTIONS)
        for name, one in found.items():
            assert one.photo == stats[name].photo and np.array_equal(one.thumbnail, stats[name].thumbnail)
    path.write_bytes(whole[: len(whole) // 2])
    assert read_stats(path, DIGESTS, OPTIONS) == {}
