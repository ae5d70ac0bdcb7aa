"""Bars around pictures, and photos that share a camera."""

import io

import numpy as np
import pytest
from PIL import Image

from sfm_app.photos.probe import group_by_camera, shown_part, unify_frames
from sfm_app.types import Photo


def textured(width, height, seed=0):
    """A picture without any line of one color."""
    rng = np.random.default_rng(seed)
    coarse = Image.fromarray(rng.integers(30, 230, (height // 16 + 2, width // 16 + 2, 3)).astype(np.uint8))
    return coarse.resize((width, height), Image.Resampling.BICUBIC)


def barred(size, frame, color=(0, 0, 0), seed=0):
    whole = Image.new("RGB", size, color)
    whole.paste(textured(frame[2], frame[3], seed), frame[:2])
    return whole


def as_jpeg(picture, quality=80):
    kept = io.BytesIO()
    picture.save(kept, "JPEG", quality=quality)
    return Image.open(kept)


def photo(name="a.jpg", shown=None, size=(600, 400), group=""):
    return Photo(name, *size, group, shown=shown)


def unified(*frames):
    return [one.shown for one in unify_frames([photo(shown=frame) for frame in frames])]


@pytest.mark.parametrize("color", [(0, 0, 0), (255, 255, 255), (20, 40, 60)])
@pytest.mark.parametrize("frame", [(0, 50, 600, 300), (80, 0, 440, 400), (0, 0, 600, 310), (0, 0, 450, 400),
                                   (30, 20, 500, 350)])  # fmt: skip
def test_pictures_within_bars_are_found(frame, color):
    picture = barred((600, 400), frame, color)
    assert shown_part(picture) == frame
    rung = shown_part(as_jpeg(picture))
    assert rung is not None
    edges = np.array([[x, y, x + w, y + h] for x, y, w, h in (frame, rung)])
    assert np.max(np.abs(edges[0] - edges[1])) <= 2


def test_pictures_without_bars_have_none():
    for seed in range(5):
        assert shown_part(textured(320, 240, seed)) is None
        assert shown_part(as_jpeg(textured(320, 240, seed), 40)) is None


def test_a_thing_on_a_plain_ground_has_no_bars():
    pixels = np.zeros((240, 320, 3), np.uint8)
    rows, columns = np.mgrid[:240, :320]
    pixels[(rows - 120) ** 2 + (columns - 160) ** 2 < 80**2] = 200
    assert shown_part(Image.fromarray(pixels)) is None
    assert shown_part(Image.new("RGB", (320, 240), (7, 7, 7))) is None


@pytest.mark.parametrize("rise_px", [10, 14, 20])
def test_a_wall_whose_end_slopes_has_no_bars(rise_px):
    pixels = np.array(barred((600, 400), (0, 0, 600, 340), (220, 225, 235)))
    rows, columns = np.mgrid[:400, :600]
    pixels[rows > 340 - rise_px * columns / 600] = (220, 225, 235)
    assert shown_part(as_jpeg(Image.fromarray(pixels), 92)) is None


def test_a_sky_of_one_color_above_a_level_horizon_is_no_bar():
    assert shown_part(barred((320, 240), (0, 100, 320, 140), (235, 235, 235))) is None


def test_frames_that_nearly_agree_become_one():
    found = unified((0, 50, 600, 300), (0, 51, 600, 299), (0, 50, 600, 301), (0, 90, 600, 220))
    assert found == [(0, 50, 600, 300)] * 3 + [(0, 90, 600, 220)]


def test_bars_that_are_not_seen_are_those_of_the_others():
    wide, narrow = (0, 50, 600, 300), (0, 90, 600, 220)
    assert unified(wide, wide, None) == [wide] * 3
    assert unified(wide, None, None) == [None] * 3  # a wall in front of a plain background, perhaps
    assert unified(wide, None) == [wide] * 2
    assert unified(wide, narrow, None) == [wide, narrow, None]


def test_pictures_of_other_sizes_are_of_other_groups():
    photos = [photo("a", (0, 50, 600, 300)), photo("b"), photo("c", (0, 52, 600, 298)), photo("d", (90, 0, 420, 400))]
    assert [one.group for one in group_by_camera(photos, "auto")] == [
        "600x299 in 600x400", "600x400", "600x299 in 600x400", "420x400 in 600x400",
    ]  # fmt: skip
    assert [one.name for one in group_by_camera(photos, "auto")] == ["a", "b", "c", "d"]


@pytest.mark.parametrize("cameras", ["single", "each"])
def test_who_says_whose_photos_they_are_is_believed(cameras):
    found = list(group_by_camera([photo("a", (0, 50, 600, 300)), photo("b", (0, 90, 600, 220))], cameras))
    assert [one.shown for one in found] == [None, None]
    assert len({one.group for one in found}) == (1 if cameras == "single" else 2)


def test_bars_turn_with_a_photo_that_is_turned():
    lying = [photo(f"{k}", (0, 50, 600, 300)) for k in range(3)]
    on_end = photo("on end", (50, 10, 300, 580), size=(400, 600))
    *_, turned = group_by_camera([*lying, on_end], "auto")
    assert (turned.width, turned.height, turned.turn_deg) == (600, 400, 90)
    # its right becomes the top
    assert turned.shown == (10, 50, 580, 300)


def panoramas(kinds, size=(800, 400)):
    return [Photo(f"{place}.jpg", *size, f"maker {place}", projection=kind) for place, kind in enumerate(kinds)]


@pytest.mark.parametrize("cameras", ["auto", "single", "each"])
def test_panoramas_always_share_one_camera(cameras):
    given = [*panoramas(["equirectangular"] * 2), Photo("x.jpg", 600, 400, "a")]
    first, second, other = (photo.group for photo in group_by_camera(given, cameras))
    assert first == second == "800x400 equirectangular" and other != first


@pytest.mark.parametrize(
    ("kinds", "size", "around"),
    [
        (["equirectangular"] * 3 + ["perspective"], (800, 400), 4),
        (["equirectangular"] + ["perspective"] * 3, (800, 400), 1),
        (["equirectangular"] * 2 + ["perspective"] * 2, (800, 400), 2),
        (["perspective"] * 4, (800, 400), 0),
        (["equirectangular"] * 3 + ["perspective"], (800, 402), 3),
    ],
    ids=["most", "few", "half", "none", "nearly twice as wide"],
)
def test_most_photos_of_a_size_decide_about_the_others(kinds, size, around):
    found = [photo.projection for photo in group_by_camera(panoramas(kinds, size), "auto")]
    assert found.count("equirectangular") == around


@pytest.mark.parametrize(
    ("cameras", "expected"),
    [
        ("auto", ["60x40 X", "60x40 X", "60x40 Y", "60x40 X"]),
        ("single", ["60x40", "60x40", "60x40", "60x40"]),
        ("folder", ["60x40 in", "60x40 .", "60x40 in", "60x40 in"]),
        ("each", ["60x40 in/a", "60x40 b", "60x40 in/c", "40x60 in/d"]),
    ],
)
def test_groups(cameras, expected):
    sizes = {"in/a": (60, 40, "X"), "b": (60, 40, "X"), "in/c": (60, 40, "Y"), "in/d": (40, 60, "X")}
    photos = [Photo(name, *size) for name, size in sizes.items()]
    assert [photo.group for photo in group_by_camera(photos, cameras)] == expected


def laid(sizes):
    """Sizes and turns of photos of these sizes, laid out."""
    photos = [Photo(f"{number}.jpg", *size, "") for number, size in enumerate(sizes)]
    return [(photo.width, photo.height, photo.turn_deg, photo.needs_copy) for photo in group_by_camera(photos, "auto")]


def test_photos_on_end_lie_as_most_of_their_camera():
    assert laid([(60, 40), (40, 60)]) == [(60, 40, 0, False), (60, 40, 90, True)]
    assert laid([(60, 40), (40, 60), (40, 60)]) == [(40, 60, 90, True), (40, 60, 0, False), (40, 60, 0, False)]
    assert laid([(40, 60), (40, 60)]) == [(40, 60, 0, False)] * 2
    assert laid([(60, 40), (40, 50)]) == [(60, 40, 0, False), (40, 50, 0, False)]
