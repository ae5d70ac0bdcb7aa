"""Names and files as COLMAP gets them, and groups."""

import numpy as np
import pycolmap
import pytest
from PIL import Image

from sfm_app.operating_system import Ability, lacks
from sfm_app.photos.decode import UnreadableError
from sfm_app.photos.probe import group_by_camera
from sfm_app.photos.source import assign_names, is_laid_out, lay_out
from sfm_app.types import Photo

PIXELS = np.random.default_rng(0).integers(0, 255, (40, 60, 3), np.uint8)


def named(*paths, lossy=True):
    return [photo.name for photo in assign_names([Photo(path, 60, 40, "g", lossy=lossy) for path in paths])]


@pytest.mark.parametrize(
    "path", ["a.jpg", "b.JPEG", "c/d e.png", "\u00fc/\U0001f600.jpg", 'it\'s; "x" & $y.png', "-o.jpg"]
)
def test_names_stay_where_they_can(path):
    assert named(path) == [path]


@pytest.mark.parametrize(
    ("path", "stored"),
    [("a.webp", "a.webp.jpg"), ("b", "b.jpg"), ("line\nbreak.jpg", "line_break.jpg"), ("\x1b[2Jx.png", "_[2Jx.png"),
     ("\udcff.jpg", "_.jpg"), ("e\u202egpj.jpg", "e_gpj.jpg")],
)  # fmt: skip
def test_names_that_colmap_or_a_terminal_cannot_have(path, stored):
    assert named(path) == [stored]


def test_what_has_lost_nothing_becomes_png():
    assert named("a.tif", "b.bmp", lossy=False) == ["a.tif.png", "b.bmp.png"]


def test_no_two_photos_get_one_name():
    found = named("a.webp", "a.webp.jpg", "x\n.jpg", "x\r.jpg", "x_.jpg", "in/a.webp")

    assert len(set(found)) == len(found)
    assert (found[1], found[4]) == ("a.webp.jpg", "x_.jpg")


def test_names_differ_by_more_than_capitals():
    assert named("a.jpg", "A.JPG", "_A.JPG", "b.webp", "B.WEBP.jpg") == [
        "a.jpg", "__A.JPG", "_A.JPG", "_b.webp.jpg", "B.WEBP.jpg",
    ]  # fmt: skip
    assert named("in/a.jpg", "In/a.jpg") == ["in/a.jpg", "In/_a.jpg"]


def test_what_it_was_called_is_kept():
    (photo,) = assign_names([Photo("a.webp", 60, 40, "g")])

    assert (photo.name, photo.path) == ("a.webp.jpg", "a.webp")


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
    photos = [
        Photo("in/a", 60, 40, "X"),
        Photo("b", 60, 40, "X"),
        Photo("in/c", 60, 40, "Y"),
        Photo("in/d", 40, 60, "X"),
    ]

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


@pytest.mark.parametrize("turn", [90, 180, 270])
def test_a_turned_photo_is_laid_out_as_the_sensor_lay(tmp_path, turn):
    upright = np.rot90(PIXELS, -turn // 90)
    Image.fromarray(np.ascontiguousarray(upright)).save(tmp_path / "x.png")

    lay_out(Photo("x.png", 60, 40, "g", needs_copy=True, lossy=False, turn_deg=turn), tmp_path, tmp_path / "target")

    with Image.open(tmp_path / "target" / "x.png") as seen:
        assert np.array_equal(np.asarray(seen), PIXELS)


def test_without_links_a_photo_is_copied_and_a_changed_copy_is_noticed(tmp_path, without):
    without(Ability.LINKS)
    photos, target, photo = tmp_path / "photos", tmp_path / "target", Photo("in/x.png", 60, 40, "g")
    (photos / "in").mkdir(parents=True)
    Image.fromarray(PIXELS).save(photos / "in/x.png")
    assert not is_laid_out(photo, photos, target)
    lay_out(photo, photos, target)
    place = target / "in/x.png"

    assert not place.is_symlink() and place.read_bytes() == (photos / "in/x.png").read_bytes()
    assert is_laid_out(photo, photos, target)
    place.write_bytes(place.read_bytes() + b"!")
    assert not is_laid_out(photo, photos, target)
    lay_out(photo, photos, target)
    assert is_laid_out(photo, photos, target)
    (photos / "in/x.png").unlink()
    assert not is_laid_out(photo, photos, target)


def test_a_link_to_another_photo_is_not_the_photo(tmp_path):
    for name in ("x.png", "y.png"):
        Image.fromarray(PIXELS).save(tmp_path / name)
    (tmp_path / "target").mkdir()
    (tmp_path / "target" / "x.png").symlink_to(tmp_path / "y.png")

    assert not is_laid_out(Photo("x.png", 60, 40, "g"), tmp_path, tmp_path / "target")


@pytest.mark.parametrize("kind", ["TIFF", "BMP", "WEBP", "PNG"])
def test_colmap_reads_and_writes_what_is_laid_out(tmp_path, kind):
    (tmp_path / "photos" / "in").mkdir(parents=True)
    path = f"in/x.{kind.lower()}"
    Image.fromarray(PIXELS).save(tmp_path / "photos" / path, kind)
    (photo,) = assign_names([Photo(path, 60, 40, "g", needs_copy=kind != "PNG", lossy=kind == "WEBP")])

    lay_out(photo, tmp_path / "photos", tmp_path / "target")

    place = tmp_path / "target" / photo.name
    seen = pycolmap.Bitmap.read(place, as_rgb=True)
    assert np.abs(seen.to_array().astype(int) - PIXELS).mean() < (0.1 if kind != "WEBP" else 60)
    assert seen.write(tmp_path / f"again{place.suffix}")
    assert place.is_symlink() == (kind == "PNG" and not lacks(Ability.LINKS))


def test_large_photos_are_scaled_down(tmp_path):
    Image.fromarray(PIXELS).save(tmp_path / "x.png")

    lay_out(Photo("x.png", 30, 20, "g", needs_copy=True, lossy=False), tmp_path, tmp_path / "target")

    with Image.open(tmp_path / "target" / "x.png") as seen:
        assert seen.size == (30, 20)


def test_a_file_that_went_away_or_led_out(tmp_path):
    (tmp_path / "photos").mkdir()
    (tmp_path / "photos" / "x.jpg").symlink_to(tmp_path / "y.jpg")

    for name, reason in (("x.jpg", "a link out of the folder"), ("z.jpg", "not there")):
        with pytest.raises(UnreadableError, match=reason):
            lay_out(Photo(name, 60, 40, "g"), tmp_path / "photos", tmp_path / "target")
