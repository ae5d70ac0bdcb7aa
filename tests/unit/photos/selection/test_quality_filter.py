"""What is of no use: blurred photos and screenshots among photos. What may be of use stays."""

import numpy as np
import pytest
from PIL import Image, ImageDraw, ImageFilter

from sfm_app.photos.selection import drop_unusable, measure_photo
from sfm_app.types import Photo

SIZE = (1024, 768)


def scene(seed=0, size=SIZE):
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
    rows = np.asarray(image, float)
    return Image.fromarray(np.mean([np.roll(rows, k, axis=1) for k in range(length)], axis=0).astype(np.uint8))


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


SHARP = [scene(seed) for seed in range(4)]


@pytest.mark.slow
@pytest.mark.parametrize("spoil", [lambda i: i.filter(ImageFilter.GaussianBlur(14)), lambda i: smeared(i, 45)])
def test_a_photo_blurred_beyond_use_is_left_out(spoil):
    assert left_out(*SHARP, spoil(scene(9))) == {4: "blurred beyond use"}


@pytest.mark.parametrize("spoil", [lambda i: i.filter(ImageFilter.GaussianBlur(3)), lambda i: smeared(i, 8)])
def test_a_photo_that_is_a_little_blurred_stays(spoil):
    assert left_out(*SHARP, spoil(scene(9))) == {}


def test_where_all_are_blurred_all_stay():
    assert left_out(*(image.filter(ImageFilter.GaussianBlur(14)) for image in SHARP)) == {}


def test_a_dark_photo_is_not_a_blurred_one():
    assert left_out(*SHARP, scene(9).point(lambda level: level // 100)) == {}


def test_a_screenshot_of_another_size_is_left_out():
    assert left_out(*SHARP, scene(5), window((720, 1280))) == {5: "a screenshot or drawing, of another size"}


def test_what_has_the_size_of_the_photos_stays_whichever_way_it_was_held():
    assert left_out(*SHARP, window(SIZE)) == {}
    assert left_out(*SHARP, window(SIZE[::-1])) == {}


def test_drawings_alone_stay():
    assert left_out(window((720, 1280)), window((640, 900)), window((500, 700))) == {}
