"""Copies of a photo are found, and what only looks alike is not one."""

import io
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from sfm_app.photos.selection import drop_duplicates
from sfm_app.photos.selection import measure_photo as look
from sfm_app.types import Photo


def scene(seed=0, shift=0):
    """A smooth picture with edges; `shift` in pixels to the side."""
    rng = np.random.default_rng(seed)
    canvas = np.full((240, 400), 90.0)
    for _ in range(60):
        x, y, w, h = rng.integers(0, [380, 220, 90, 90])
        canvas[y : y + h, x : x + w] = rng.uniform(0, 255)
    return Image.fromarray(canvas[:, 20 + shift : 340 + shift].astype(np.uint8)).convert("RGB")


def glance(name, image):
    return look(Photo(name, *image.size, "one"), image)


def saved(image, **options):
    buffer = io.BytesIO()
    image.save(buffer, "JPEG", **options)
    return Image.open(buffer)


def names(photos):
    return [photo.name for photo in photos]


@pytest.mark.parametrize(
    "change",
    [
        lambda image: image,
        lambda image: saved(image, quality=60),
        lambda image: image.resize((160, 120), Image.Resampling.LANCZOS),
        lambda image: image.convert("L"),
    ],
)
def test_the_largest_of_each_picture_stays(change):
    kept, copies = drop_duplicates([glance("copy.jpg", change(scene())), glance("b.jpg", scene(1))])
    assert names(kept) == ["copy.jpg", "b.jpg"] and not copies

    bigger = scene().resize((640, 480), Image.Resampling.LANCZOS)
    kept, copies = drop_duplicates(
        [glance("copy.jpg", change(scene())), glance("b.jpg", scene(1)), glance("c", bigger)]
    )
    assert names(kept) == ["b.jpg", "c"]
    assert [(photo.name, photo.reason) for photo in copies] == [("copy.jpg", "the same picture as c")]


@pytest.mark.parametrize("shift", [4, 10, 20])
def test_a_step_to_the_side_is_another_photo(shift):
    kept, _ = drop_duplicates([glance("a", scene()), glance("b", scene(0, shift))])

    assert len(kept) == 2


def test_a_bright_and_a_dark_exposure_are_two_photos():
    dark = scene().point(lambda gray: gray // 2)

    assert len(drop_duplicates([glance("a", scene()), glance("b", dark)])[0]) == 2


def test_blank_pictures_say_nothing():
    blank = Image.new("RGB", (320, 240), "gray")

    assert len(drop_duplicates([glance(name, blank) for name in "abc"])[0]) == 3
    assert drop_duplicates([]) == ([], [])


def test_all_copies_of_one_go_to_one():
    kept, copies = drop_duplicates([glance(name, scene()) for name in ("c", "a", "b")])

    assert names(kept) == ["c"]
    assert {photo.reason for photo in copies} == {"the same picture as c"}


def test_of_copies_the_one_with_a_mask_stays():
    """Else what somebody has masked would be used from its copy."""
    large, small = glance("a.jpg", scene()), glance("b.jpg", scene().resize((160, 120), Image.Resampling.LANCZOS))
    masked = replace(small, photo=replace(small.photo, mask="b.jpg.png"))

    assert names(drop_duplicates([large, small])[0]) == ["a.jpg"]
    assert names(drop_duplicates([large, masked])[0]) == ["b.jpg"]
